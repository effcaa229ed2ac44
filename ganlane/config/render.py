"""Root of ``ganlane render``."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from ganlane.config.env import EnvConfig, check_reward
from ganlane.config.run import GeneratorFile, RunConfig
from ganlane.config.traffic import TrafficConfig
from ganlane.errors import ParameterError, UserError
from ganlane.parameters.checks import Rule, above, at_least, between, check, every, optional, text
from ganlane.parameters.observation import MaskParameters, ObservationConfig
from ganlane.parameters.reward import RewardParameters

#: Films of one episode; pages and tables of any number of episodes.
FILMS = ("gif", "mp4", "png")
#: Learning curves.
CHARTS = ("png", "svg", "pdf")
FORMATS = (*FILMS, "html", "csv", "parquet", "svg", "pdf")
MOST_EPISODES = 12
#: A GIF of a whole episode takes minutes to draw, and tens of MB.
GIF_S = 30.0


@dataclass
class FilmConfig:
    """``film``: which part of the episode, how fast, how large.

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

    fps: float = 20.0
    speedup: float = 1.0
    start_s: float = 0.0
    end_s: float | None = None
    width: int = 1280
    height: int = 320
    road_m: float = 160.0
    trail_s: float = 3.0
    speeds: bool = True
    leader_line: bool = False
    scale: float = 1.0
    max_bytes: int | None = None

    def __post_init__(self) -> None:
        check(
            self,
            fps=between(1, 120),
            speedup=above(0),
            start_s=at_least(0),
            end_s=optional(above(0)),
            width=between(600, 7680),
            height=between(160, 4320),
            road_m=above(0),
            trail_s=at_least(0),
            scale=between(0.05, 4),
            max_bytes=optional(at_least(10_000)),
        )
        if self.end_s is not None and self.end_s <= self.start_s:
            raise ParameterError(f"{{end_s}}={self.end_s:g}: expected more than {{start_s}}={self.start_s:g}.")


@dataclass
class CurvesConfig:
    """``curves``: how the figures of training runs are drawn.

    Attributes:
        columns: of metrics.csv and evaluation_NAME of evaluation.csv; null: the ones that matter most.
        smooth: rows that a running mean takes in.
    """

    columns: list[str] | None = None
    smooth: int = 1

    def __post_init__(self) -> None:
        check(self, columns=optional(every(text())), smooth=at_least(1))


@dataclass
class RenderConfig(RunConfig):
    """Episodes of agents on one traffic, as a film, page or table; or the learning curves of runs.

    Attributes:
        driver: agent=NAME says the same: a name, path or import path as in ganlane evaluate.
        episode: of the seed, on the stream kept for reports: the episodes of ganlane evaluate.
        agents: html, csv, parquet: several instead of driver, for instance agents=[mobil,agent_idm].
        episodes: html, csv, parquet: several instead of episode, for instance episodes=[0,1,2].
        run: instead of an episode: learning curves of runs, run=FOLDER or run=FOLDER,FOLDER.
        format: gif, mp4 (needs the extra 'video'), png (a strip of four frames), html (a player), csv or parquet
            (trajectories); null: the ending of out, else gif.
        out: file to write; null: into the run folder.
        generator: weights of generated traffic.
        film: how a film looks.
        curves: how learning curves look.
    """

    driver: str = "agent_general"
    episode: int = 0
    agents: list[str] | None = None
    episodes: list[int] | None = None
    run: list[str] | None = None
    format: str | None = None
    out: str | None = None
    env: EnvConfig = field(default_factory=EnvConfig)
    traffic: TrafficConfig = field(default_factory=TrafficConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    mask: MaskParameters = field(default_factory=MaskParameters)
    reward: RewardParameters = field(default_factory=RewardParameters)
    generator: GeneratorFile = field(default_factory=GeneratorFile)
    film: FilmConfig = field(default_factory=FilmConfig)
    curves: CurvesConfig = field(default_factory=CurvesConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        number = between(0, 2**53)
        check(self, episode=number, format=_FORMAT, run=optional(every(text())))
        check(self, agents=optional(_DIFFERENT), episodes=optional(_DIFFERENT))
        check(self, episodes=optional(every(number)))
        check_reward(self.env, self.reward)
        if self.out is not None:
            _check_out(Path(self.out))
        self._check_kind()

    @property
    def kind(self) -> str:
        """The format that is asked for: ``format``, or the ending of ``out``, or png for ``run``, else gif."""
        ending = Path(self.out).suffix.removeprefix(".").lower() if self.out is not None else ""
        return self.format or ending or ("gif" if self.run is None else "png")

    @property
    def end_s(self) -> float | None:
        """``film.end_s``, or where a GIF ends by default; None: with the episode."""
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

    def _check_kind(self) -> None:
        """What is asked for, what the file is called and how many episodes there are must fit together."""
        _check_suffix(self.out, self.kind)
        if self.run is not None and self.kind not in CHARTS:
            raise UserError(
                f"format={self.kind}: learning curves are one of {', '.join(CHARTS)}; choose one of these."
            )
        if self.run is None and self.kind in ("svg", "pdf"):
            raise UserError(
                f"format={self.kind}: for learning curves only; episodes are gif, mp4, png, html, csv or parquet."
            )
        if self.kind == "mp4":
            require_video()
        count = len(self.pairs())
        if self.kind in FILMS and count > 1:
            raise UserError(
                f"format={self.kind}: a film shows one episode, not {count}; use format=html for several."
            )
        if count > MOST_EPISODES:
            raise UserError(f"agents x episodes: {count} episodes; choose at most {MOST_EPISODES}.")


_FORMAT = Rule(lambda value: value is None or value in FORMATS, f"one of {', '.join(FORMATS)}")
_DIFFERENT = Rule(lambda all: len(all) > 0 and len(set(all)) == len(all), "a list of different entries, not empty")


def _check_suffix(out: str | None, kind: str) -> None:
    """The file's name must not promise what it does not hold."""
    ending = Path(out).suffix.removeprefix(".").lower() if out is not None else ""
    if ending and ending not in FORMATS:
        raise UserError(f"out={out}: expected one of {', '.join(FORMATS)}; give the file one of these endings.")
    if ending and ending != kind:
        raise UserError(f"out={out}: the ending says {ending} and format {kind}; give one of them.")


def _check_out(path: Path) -> None:
    """The film's folder must be there; nothing else is made on the way."""
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise UserError(f"out={path}: expected a file in a folder that exists and can be written to; make it first.")


def require_video() -> None:
    """Raise :class:`UserError` where the extra for mp4 is missing."""
    try:
        import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        raise UserError(
            "format=mp4: needs the extra 'video'; run `pip install \"ganlane[video]\"` or choose format=gif."
        ) from error
