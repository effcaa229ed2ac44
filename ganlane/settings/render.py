"""Configuration of ``ganlane render``."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from ganlane.errors import ParameterError, UserError
from ganlane.settings.commands import DrivingConfig, Measured, Names
from ganlane.settings.record import DIFFERENT, NotNegative, Positive, Record, Seed, Text, between
from ganlane.settings.traffic import IdmMobilTrafficConfig, TrafficConfig

#: Learning curves.
CHARTS = ("png", "svg", "pdf")
#: Any number of episodes.
PAGES = ("html", "parquet")
#: One episode.
FILMS = ("gif", "mp4", "png")
MOST_EPISODES = 12
#: A GIF of a whole episode takes minutes to draw, and tens of MB.
GIF_S = 30.0


@dataclass(frozen=True)
class FilmConfig(Record):
    """``film``: part of the episode, speed and size.

    Attributes:
        fps: frames per second.
        speedup: simulated seconds per second of film.
        start_s: part of the episode, for every format, s.
        end_s: null: to its end; of a gif, 30 s after start_s.
        width: pixels.
        height: pixels.
        road_m: length of road in the picture, m.
        trail_s: length of the trails, s; 0: none.
        speeds: numbers on the roofs.
    """

    # which part of the episode, how fast
    fps: Annotated[float, between(1, 120)] = 20.0
    speedup: Positive = 1.0
    start_s: NotNegative = 0.0
    end_s: Positive | None = None
    # the picture
    width: Annotated[int, between(600, 7680)] = 1280
    height: Annotated[int, between(160, 4320)] = 320
    road_m: Positive = 160.0
    trail_s: NotNegative = 3.0
    speeds: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.end_s is not None and self.end_s <= self.start_s:
            raise ParameterError(
                f"{{end_s}}={self.end_s:g}: expected more than {{start_s}}={self.start_s:g}."
            )


@dataclass(frozen=True)
class RenderConfig(DrivingConfig):
    """Episodes of agents on one traffic, as a film, page or table; or the learning curves of runs.

    Attributes:
        agents: agent=NAME says the same: names, paths or import paths as in ganlane evaluate; html,
            parquet: several, agents=[mobil,agent_idm]; null: agent_general.
        episodes: episode=NUMBER says the same: of the seed and stream, the same as in ganlane
            evaluate; html, parquet: several, episodes=[0,1,2]; null: 0.
        stream: benchmark: the episodes of ganlane benchmark.
        run: instead of an episode: learning curves of runs, run=FOLDER or 'run=[FOLDER,FOLDER]'.
        out: file to write, whose ending says what: gif, mp4 (needs the extra 'video'), png (a strip
            of four frames), html (a player), parquet (trajectories); of learning curves png, svg,
            pdf; null: a gif, or png of curves, into the run folder.
        film: how a film looks.
    """

    # what is shown
    agents: Names | None = None
    stream: Measured = "report"
    episodes: Annotated[list[Seed], DIFFERENT] | None = None
    run: Annotated[list[Text], DIFFERENT] | None = None
    # how, and where it goes
    out: str | None = None
    traffic: TrafficConfig = IdmMobilTrafficConfig()
    film: FilmConfig = FilmConfig()

    def __post_init__(self) -> None:
        super().__post_init__()
        kind, count = self.kind, len(self.pairs())
        path = Path(self.out or "")
        endings = CHARTS if self.run else FILMS + PAGES
        if path.name and (path.is_dir() or not os.access(path.parent, os.W_OK)):
            raise UserError(
                f"out={path}: expected a file in a folder that exists and can be written to; make "
                "it first."
            )
        if kind not in endings:
            raise UserError(
                f"out={path}: the ending is {kind}, expected one of {', '.join(endings)}; choose "
                "one of these."
            )
        if kind in FILMS and count > 1:
            raise UserError(
                f"out={path}: a film shows one episode, not {count}; for several give a file "
                "that ends in .html."
            )
        if count > MOST_EPISODES:
            raise UserError(f"agents x episodes: {count} episodes; choose at most {MOST_EPISODES}.")
        if kind == "mp4" and find_spec("imageio_ffmpeg") is None:
            raise UserError(
                f"out={path}: mp4 needs the extra 'video'; run `pip install \"ganlane[video]\"` or "
                "choose a gif."
            )

    @property
    def kind(self) -> str:
        """The ending of ``out``, without the dot, else what suits what is drawn."""
        # Curves are a picture, an episode is a film.
        default = "gif" if self.run is None else "png"
        return Path(self.out or "").suffix.removeprefix(".").lower() or default

    @property
    def look(self) -> FilmConfig:
        """``film``, with the default end of a GIF where none is given."""
        if self.film.end_s is not None or self.kind != "gif":
            return self.film
        return replace(self.film, end_s=self.film.start_s + GIF_S)

    def pairs(self) -> list[tuple[str, int]]:
        """The episodes to record: agent and number of each."""
        # Episode by episode, so that the agents of one stand side by side.
        return [
            (agent, episode)
            for episode in self.episodes or [0]
            for agent in self.agents or ["agent_general"]
        ]
