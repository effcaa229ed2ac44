"""``render``: episodes as a film, page or table, and learning curves, as ``ganlane render`` draws them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ganlane.api.folders import run_in, torch_threads
from ganlane.api.options import Option, command_config
from ganlane.config.render import RenderConfig


def render(
    agent: str | Sequence[str] = "mobil",
    traffic: Option = "idm_mobil",
    episode: int | Sequence[int] = 0,
    *,
    seed: int = 0,
    format: str | None = None,
    out: str | Path | None = None,
    run: str | Path | Sequence[str | Path] | None = None,
    env: Option = "highway",
    observation: Option = "lane_view_overlap",
    reward: Option = "paper",
    film: Mapping[str, Any] | None = None,
    **overrides: Any,
) -> Path:
    """Episodes of agents on a traffic as a film, page or table, or the learning curves of runs; the file's path.

    ::

        render("agent_idm", "gan", episode=3, out="film.mp4", film={"end_s": 20.0})
        render(["mobil", "agent_idm"], "gan", episode=[0, 1], out="player.html")
        render(run=["outputs/train/FIRST", "outputs/train/SECOND"], out="curves.png")

    On the command line: ``ganlane render agent=agent_idm traffic=gan episode=3 out=film.mp4 film.end_s=20``.

    Args:
        agent: a name, path or import path, as in :func:`ganlane.api.load_agent`; several for html, csv and parquet.
        traffic, env, observation, reward: as in :func:`ganlane.api.make_env`.
        episode, seed: the episode's numbers; the episodes are those of ``evaluate``; several as for ``agent``.
        format: ``gif``, ``mp4`` or ``png`` (films), ``html`` (a player), ``csv`` or ``parquet`` (trajectories that
            read back like recorded traffic); None: the ending of ``out``, else ``gif``.
        out: file to write; None: into a new folder below ``outputs/render``.
        run: folders of training runs; their learning curves are drawn instead of an episode.
        film: keys of the film: ``fps, speedup, start_s, end_s, width, height, ...``.
        overrides: keys of the command or of the environment.

    Raises:
        UserError: a wrong value.
        OSError: a file that cannot be written.
    """
    from ganlane.render import render as command

    ending = Path(out).suffix.removeprefix(".").lower() if out is not None else ""
    parts: dict[str, Option] = {"env": env, "traffic": traffic, "observation": observation, "reward": reward}
    told = {
        **({"driver": agent} if isinstance(agent, str) else {"agents": list(agent)}),
        **({"episode": episode} if isinstance(episode, int) else {"episodes": list(episode)}),
        "run": None if run is None else [str(each) for each in _several(run)],
        "seed": seed,
        "format": format or ending or None,
        "film": film or {},
    }
    config = command_config(RenderConfig, parts, {**overrides, **told, "out": None if out is None else str(out)})
    if out is None:
        _, line = run_in(None, "render", command, config)
    else:
        with torch_threads():
            line = command(config, Path(out).parent)
    return Path(line.partition(": ")[2])


def _several(run: str | Path | Sequence[str | Path]) -> Sequence[str | Path]:
    return [run] if isinstance(run, str | Path) else run
