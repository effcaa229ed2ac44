"""Configuration of ``ganlane render``."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from ganlane.errors import ParameterError, UserError, as_typed
from ganlane.settings.commands import DrivingConfig, Names
from ganlane.settings.record import (
    DIFFERENT,
    Count,
    NotNegative,
    Positive,
    Record,
    Seed,
    Text,
    at_least,
    between,
    one_of,
)
from ganlane.settings.traffic import IdmMobilTrafficConfig, TrafficConfig

#: Films of one episode; pages and tables of any number of episodes.
FILMS = ("gif", "mp4", "png")
#: Learning curves.
CHARTS = ("png", "svg", "pdf")
FORMATS = (*FILMS, "html", "csv", "parquet", "svg", "pdf")
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
        leader_line: a line to the leader, with the gap.
        scale: size of the film, as a share of the picture's.
        max_bytes: gif: size and frame rate are lowered until it fits; html: the rate of samples.
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
    leader_line: bool = False
    # the file
    scale: Annotated[float, between(0.05, 4)] = 1.0
    max_bytes: Annotated[int, at_least(10_000)] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.end_s is not None and self.end_s <= self.start_s:
            raise ParameterError(
                f"{{end_s}}={self.end_s:g}: expected more than {{start_s}}={self.start_s:g}."
            )


@dataclass(frozen=True)
class CurvesConfig(Record):
    """``curves``: learning curves of training runs.

    Attributes:
        columns: of metrics.csv and evaluation_NAME of evaluation.csv; null: the ones that matter
            most.
        smooth: rows that a running mean takes in.
    """

    columns: list[Text] | None = None
    smooth: Count = 1


@dataclass(frozen=True)
class RenderConfig(DrivingConfig):
    """Episodes of agents on one traffic, as a film, page or table; or the learning curves of runs.

    Attributes:
        driver: agent=NAME says the same: a name, path or import path as in ganlane evaluate.
        episode: of the seed, on the stream kept for reports: the episodes of ganlane evaluate.
        agents: html, csv, parquet: several instead of driver, for instance
            agents=[mobil,agent_idm].
        episodes: html, csv, parquet: several instead of episode, for instance episodes=[0,1,2].
        run: instead of an episode: learning curves of runs, run=FOLDER or 'run=[FOLDER,FOLDER]'.
        crashes: instead of an episode: the crashes.json of ganlane reproduce, whose episodes are
            driven again with their actions; agents, episodes and traffics choose among them.
        traffics: of crashes: on these traffics alone.
        format: gif, mp4 (needs the extra 'video'), png (a strip of four frames), html (a player),
            csv or parquet (trajectories); null: the ending of out, else gif.
        out: file to write; null: into the run folder.
        film: how a film looks.
        curves: how learning curves look.
    """

    # what is shown
    driver: str = "agent_general"
    episode: Seed = 0
    agents: Annotated[list[str], DIFFERENT] | None = None
    episodes: Annotated[list[Seed], DIFFERENT] | None = None
    run: list[Text] | None = None
    crashes: Text | None = None
    traffics: Names | None = None
    # how, and where it goes
    format: Annotated[str, one_of(FORMATS)] | None = None
    out: str | None = None
    traffic: TrafficConfig = field(default_factory=IdmMobilTrafficConfig)
    film: FilmConfig = field(default_factory=FilmConfig)
    curves: CurvesConfig = field(default_factory=CurvesConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.out is not None:
            path = Path(self.out)
            if path.is_dir() or not os.access(path.parent, os.W_OK):
                raise UserError(
                    f"out={path}: expected a file in a folder that exists and can be written to; "
                    "make it first."
                )
        ending = self._ending()
        if ending and ending not in FORMATS:
            raise UserError(
                f"out={self.out}: expected one of {', '.join(FORMATS)}; give the file one of these "
                "endings."
            )
        if ending and ending != self.kind:
            raise UserError(
                f"out={self.out}: the ending says {ending} and format {self.kind}; give one of "
                "them."
            )
        if self.run is not None and self.kind not in CHARTS:
            raise UserError(
                f"format={self.kind}: learning curves are one of {', '.join(CHARTS)}; choose one "
                "of these."
            )
        if self.run is None and self.kind in ("svg", "pdf"):
            raise UserError(
                f"format={self.kind}: for learning curves only; episodes are gif, mp4, png, html, "
                "csv or parquet."
            )
        if self.kind == "mp4" and find_spec("imageio_ffmpeg") is None:
            raise UserError(
                "format=mp4: needs the extra 'video'; run `pip install \"ganlane[video]\"` or "
                "choose format=gif."
            )
        if self.crashes is not None:
            if self.run is not None:
                raise UserError(
                    "crashes and run: either crashes or learning curves are drawn; leave one of "
                    "them out."
                )
            if self.kind in FILMS:
                raise UserError(
                    f"format={self.kind}: shows one episode; crashes are html, csv or parquet."
                )
            return
        if self.traffics is not None:
            raise UserError(
                f"traffics={as_typed(self.traffics)}: goes with crashes=FILE; else give "
                "traffic=NAME."
            )
        count = len(self.pairs())
        if self.kind in FILMS and count > 1:
            raise UserError(
                f"format={self.kind}: a film shows one episode, not {count}; use format=html for "
                "several."
            )
        if count > MOST_EPISODES:
            raise UserError(f"agents x episodes: {count} episodes; choose at most {MOST_EPISODES}.")

    def _ending(self) -> str:
        """The ending of ``out``, without the dot; empty: none."""
        return Path(self.out or "").suffix.removeprefix(".").lower()

    @property
    def kind(self) -> str:
        """``format``, else the ending of ``out``, else png for ``run``, html for ``crashes``, gif
        for episodes.
        """
        default = "png" if self.run is not None else "gif" if self.crashes is None else "html"
        return self.format or self._ending() or default

    @property
    def end_s(self) -> float | None:
        """``film.end_s``, or the default end of a GIF; None: the end of the episode."""
        if self.film.end_s is not None or self.kind != "gif":
            return self.film.end_s
        return self.film.start_s + GIF_S

    def pairs(self) -> list[tuple[str, int]]:
        """The episodes to record: agent and number of each."""
        return [
            (agent, episode)
            for episode in (self.episodes if self.episodes is not None else [self.episode])
            for agent in (self.agents if self.agents is not None else [self.driver])
        ]
