"""Draw episodes as a film, an HTML player or a table; draw learning curves of runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ganlane.build import make_driver
from ganlane.errors import UserError
from ganlane.evaluation.episodes import ScriptedPolicy
from ganlane.settings.render import FILMS, MOST_EPISODES, RenderConfig
from ganlane.sim.random import Stream
from ganlane.suite.crashes import read_crashes
from ganlane.suite.episodes import drive_episode
from ganlane.torch_settings import set_threads
from ganlane.view import Trajectory, record_episode, write_film, write_player, write_tracks
from ganlane.view.curves import draw_runs, read_runs
from ganlane.view.figures import save_figure


def render(config: RenderConfig, folder: Path) -> str:
    """Draw episodes or learning curves; the line that names the file."""
    kind = config.kind
    # Learning curves need no simulator.
    if config.run is not None:
        out = Path(config.out or folder / f"curves.{kind}")
        return f"curves: {save_figure(draw_runs(read_runs(config.run)), out)}"
    set_threads(config.threads)
    if config.crashes is not None:
        episodes = _crashes(config, config.crashes)
        name = "crashes"
    else:
        episodes = []
        for agent, number in config.pairs():
            end_s = config.look.end_s
            # Episode k here is episode k of an evaluation.
            stream = Stream.named(config.stream)
            driver = make_driver(agent, config.env, stream, config.device)
            episode = drive_episode(driver, config.traffic, config, number, end_s)
            print(_sentence(episode))
            episodes.append(episode)
        # A name of what is shown, so that several pictures can lie in one folder.
        labels = [episode.label for episode in episodes]
        agents = dict.fromkeys(Path(label.agent).stem for label in labels)
        numbers = dict.fromkeys(str(label.episode) for label in labels)
        name = "_".join([*agents, config.traffic.label(), str(config.seed), *numbers])
    out = Path(config.out or folder / f"{name}.{kind}")
    if kind in FILMS:
        return f"film: {write_film(episodes[0], out, config.look)}"
    if kind == "html":
        return f"player: {write_player(episodes, out, config.look)}"
    # Films and pages cut off the beginning themselves; a table has it cut off here.
    shown = [episode.since(config.look.start_s) for episode in episodes]
    return f"tracks: {write_tracks(shown, out)}"


def _sentence(episode: Trajectory) -> str:
    label = episode.label
    which = f"{label.agent} on {label.traffic}, seed {label.seed}, episode {label.episode}"
    return f"{which}: {episode.outcome or 'cut off'} after {episode.time_s[-1]:.1f} s"


def _crashes(config: RenderConfig, path: str) -> list[Trajectory]:
    """Drive the chosen episodes of a list of crashes again, with their actions.

    Raises:
        UserError: no such list, or none of its episodes is chosen.
    """
    listed = read_crashes(path)

    def is_chosen(value: Any, among: Sequence[Any] | None) -> bool:
        return among is None or value in among

    chosen = [
        crash
        for crash in listed.crashes
        if is_chosen(crash.driver, config.agents)
        and is_chosen(crash.episode, config.episodes)
        and is_chosen(crash.traffic, config.traffics)
    ]
    if not chosen:
        drivers = dict.fromkeys(crash.driver for crash in listed.crashes)
        raise UserError(
            f"crashes={path}: none of these agents, episodes and traffics; it lists "
            f"{', '.join(drivers) or 'none at all'}."
        )
    if len(chosen) > MOST_EPISODES:
        print(
            f"the first {MOST_EPISODES} of {len(chosen)} crashes; agents, traffics and episodes "
            "choose others"
        )
    episodes = []
    for crash in chosen[:MOST_EPISODES]:
        env = listed.make_env(crash.traffic, reward=config.reward)
        # The listed actions are repeated, so the driver itself need not be loaded.
        policy = ScriptedPolicy({crash.episode: crash.actions})
        which = (crash.seed, crash.episode, crash.driver, crash.traffic)
        episode = record_episode(
            env,
            policy,
            *which,
            config.look.end_s,
        )
        # Cut off by film.end_s is no difference. Another end is: the code has changed since.
        differs = episode.outcome not in (crash.end, "")
        print(_sentence(episode) + (f" (listed: {crash.end})" if differs else ""))
        episodes.append(episode)
    return episodes
