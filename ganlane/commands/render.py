"""Draw episodes as a film, an HTML player or a table of trajectories; draw learning curves of runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ganlane.build import make_driver, make_env, make_traffic
from ganlane.errors import UserError
from ganlane.evaluation.episodes import ScriptedPolicy
from ganlane.reproduce.crashes import read_crashes
from ganlane.settings.render import FILMS, MOST_EPISODES, RenderConfig
from ganlane.sim.random import Stream
from ganlane.torch_settings import set_threads
from ganlane.view import (
    DrawingParameters,
    Film,
    FramePainter,
    Trajectory,
    WindowParameters,
    record_episode,
    write_film,
    write_player,
    write_tracks,
)
from ganlane.view.figures import draw_runs, read_runs, save_figure
from ganlane.view.film import film_format


def render(config: RenderConfig, folder: Path) -> str:
    """Draw episodes or learning curves; the line that names the file."""
    if config.run is not None:
        return _curves(config, config.run, folder)
    set_threads(config.threads)
    if config.crashes is not None:
        episodes = _crashes(config, config.crashes)
    else:
        episodes = [_record(config, agent, episode) for agent, episode in config.pairs()]
    kind, film = config.kind, config.film
    out = Path(config.out) if config.out is not None else folder / _name(config)
    if kind in FILMS:
        return _film(config, episodes[0], out)
    shown = [episode.since(film.start_s) for episode in episodes]
    if kind == "html":
        return f"player: {write_player(shown, out, film.max_bytes)}"
    return f"tracks: {write_tracks(shown, out, 'csv' if kind == 'csv' else 'parquet')}"


def _record(config: RenderConfig, agent: str, number: int) -> Trajectory:
    """Drive an episode and print how it ended."""
    label = config.traffic.label()
    driver = make_driver(agent, config.env, device=config.device)
    traffic = make_traffic(config.traffic, config.env, Stream.REPORT)
    seen = config.observation.read_by(driver.observation)
    mask, policy = driver.behind(config.mask)
    env = make_env(traffic, config.env, seen, config.reward, device=config.device, mask=mask)
    end_s = config.end_s if config.end_s is not None else float("inf")
    episode = record_episode(env, policy, config.seed, number, driver.name, label, end_s)
    print(_sentence(episode))
    return episode


def _sentence(episode: Trajectory) -> str:
    label = episode.label
    which = f"{label.agent} on {label.traffic}, seed {label.seed}, episode {label.episode}"
    return f"{which}: {episode.outcome or 'cut off'} after {episode.time_s[-1]:.1f} s"


def _crashes(config: RenderConfig, path: str) -> list[Trajectory]:
    """Drive the chosen episodes of a list of crashes again, with their actions.

    Raises:
        UserError: no such list, or none of its episodes is chosen.
    """
    listed, episodes = read_crashes(path), []
    chosen = [
        each
        for each in listed.crashes
        if each.driver in (config.agents or [each.driver])
        and each.episode in (config.episodes or [each.episode])
        and each.traffic in (config.traffics or [each.traffic])
    ]
    if not chosen:
        drivers = ", ".join(dict.fromkeys(each.driver for each in listed.crashes)) or "none at all"
        raise UserError(
            f"crashes={path}: none of these agents, episodes and traffics; it lists {drivers}."
        )
    if len(chosen) > MOST_EPISODES:
        print(
            f"the first {MOST_EPISODES} of {len(chosen)} crashes; agents, traffics and episodes choose others"
        )
    end_s = config.end_s if config.end_s is not None else float("inf")
    for each in chosen[:MOST_EPISODES]:
        env = listed.make_env(each.traffic, reward=config.reward)
        policy = ScriptedPolicy({each.episode: each.actions})
        episodes.append(
            record_episode(env, policy, each.seed, each.episode, each.driver, each.traffic, end_s)
        )
        changed = f" (listed: {each.end})" if episodes[-1].outcome not in (each.end, "") else ""
        print(f"{_sentence(episodes[-1])}{changed}")
    return episodes


def _film(config: RenderConfig, episode: Trajectory, out: Path) -> str:
    """Draw an episode and write the film."""
    film = config.film
    window = WindowParameters(width=film.width, height=film.height, length_m=film.road_m)
    painter = FramePainter(
        episode, window, DrawingParameters(film.trail_s, film.speeds, film.leader_line)
    )
    frames = Film(painter, film.fps, film.speedup, film.start_s, config.end_s)
    return f"film: {write_film(frames, out, film.fps, film_format(out, config.kind), film.max_bytes, film.scale)}"


def _curves(config: RenderConfig, runs: Sequence[str], folder: Path) -> str:
    """Draw the learning curves of ``runs``."""
    out = Path(config.out) if config.out is not None else folder / f"curves.{config.kind}"
    figure = draw_runs(read_runs(runs), config.curves.columns, config.curves.smooth)
    return f"curves: {save_figure(figure, out, config.kind)}"


def _name(config: RenderConfig) -> str:
    """The file's name where none is given: agents, traffic, seed, episodes."""
    if config.crashes is not None:
        return f"crashes.{config.kind}"
    agents = dict.fromkeys(Path(agent).stem for agent, _ in config.pairs())
    numbers = dict.fromkeys(str(number) for _, number in config.pairs())
    parts = [*agents, config.traffic.label(), str(config.seed), *numbers]
    return f"{'_'.join(parts)}.{config.kind}"
