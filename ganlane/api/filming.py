"""``render``: an episode as a film, as ``ganlane render`` draws it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ganlane.api.folders import run_in, torch_threads
from ganlane.api.options import Option, command_config
from ganlane.config.render import RenderConfig


def render(
    agent: str = "mobil",
    traffic: Option = "idm_mobil",
    episode: int = 0,
    *,
    seed: int = 0,
    format: str | None = None,
    out: str | Path | None = None,
    env: Option = "highway",
    observation: Option = "lane_view",
    reward: Option = "paper",
    film: Mapping[str, Any] | None = None,
    **overrides: Any,
) -> Path:
    """An episode of an agent on a traffic as a film; the film's path.

    ::

        render("agent_idm", "gan", episode=3, out="film.mp4", film={"end_s": 20.0})

    On the command line: ``ganlane render agent=agent_idm traffic=gan episode=3 out=film.mp4 film.end_s=20``.

    Args:
        agent: a name, path or import path, as in :func:`ganlane.api.load_agent`.
        traffic, env, observation, reward: as in :func:`ganlane.api.make_env`.
        episode, seed: the episode's numbers; the episodes are those of ``evaluate``.
        format: ``gif``, ``mp4`` or ``png``; None: the ending of ``out``, else ``gif``.
        out: file to write; None: into a new folder below ``outputs/render``.
        film: keys of the film: ``fps, speedup, start_s, end_s, width, height, ...``.
        overrides: keys of the command or of the environment.

    Raises:
        UserError: a wrong value, or a file that cannot be written.
    """
    from ganlane.render import render as command

    ending = Path(out).suffix.removeprefix(".").lower() if out is not None else ""
    parts: dict[str, Option] = {"env": env, "traffic": traffic, "observation": observation, "reward": reward}
    told = {
        "driver": agent,
        "episode": episode,
        "seed": seed,
        "format": format or ending or "gif",
        "film": film or {},
    }
    config = command_config(RenderConfig, parts, {**overrides, **told, "out": None if out is None else str(out)})
    if out is None:
        _, line = run_in(None, "render", command, config)
    else:
        with torch_threads():
            line = command(config, Path(out).parent)
    return Path(line.removeprefix("film: "))
