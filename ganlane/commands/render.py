"""Draw episodes as a film, an HTML player or a table; draw learning curves of runs."""

from __future__ import annotations

from pathlib import Path

from ganlane.build import make_driver
from ganlane.settings.render import FILMS, RenderConfig
from ganlane.sim.random import Stream
from ganlane.suite.driving import drive_episode
from ganlane.view import write_film, write_player, write_tracks
from ganlane.view.curves import draw_runs, read_runs
from ganlane.view.figures import save_figure


def render(config: RenderConfig, folder: Path) -> str:
    """Draw episodes or learning curves; the line that names the file.

    Learning curves are drawn where ``config.run`` names runs, else the episodes that the other keys
    name, in the format ``config.kind``.
    """
    kind = config.kind
    # Learning curves need no simulator.
    if config.run is not None:
        out = Path(config.out or folder / f"curves.{kind}")
        figure = draw_runs(read_runs(config.run))
        return f"curves: {save_figure(figure, out)}"

    episodes = []
    stream = Stream.named(config.stream)
    for agent, number in config.pairs():
        # Episode k here is episode k of an evaluation.
        driver = make_driver(agent, config.env, stream, config.device)
        episode = drive_episode(driver, config.traffic, config, number, config.look.end_s)
        label = episode.label
        which = f"{label.agent} on {label.traffic}, seed {label.seed}, episode {label.episode}"
        print(f"{which}: {episode.outcome or 'cut off'} after {episode.time_s[-1]:.1f} s")
        episodes.append(episode)

    # A name of what is shown, so that several pictures can lie in one folder; agents and numbers
    # once each, in their order.
    labels = [episode.label for episode in episodes]
    agents = dict.fromkeys(Path(label.agent).stem for label in labels)
    numbers = dict.fromkeys(str(label.episode) for label in labels)
    name = "_".join(
        [
            *agents,
            config.traffic.label(),
            str(config.seed),
            *numbers,
        ]
    )
    out = Path(config.out or folder / f"{name}.{kind}")

    if kind in FILMS:
        # A film shows one episode; the settings refuse more.
        return f"film: {write_film(episodes[0], out, config.look)}"
    if kind == "html":
        return f"player: {write_player(episodes, out, config.look)}"
    # Films and pages cut off the beginning themselves; a table has it cut off here.
    shown = [episode.since(config.look.start_s) for episode in episodes]
    return f"tracks: {write_tracks(shown, out)}"
