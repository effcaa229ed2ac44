"""Root of ``ganlane render``."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from ganlane.config.checks import above, at_least, between, check, one_of, optional
from ganlane.config.env import EnvConfig
from ganlane.config.observation import ObservationConfig
from ganlane.config.reward import RewardConfig, check_pay
from ganlane.config.run import GeneratorFile, RunConfig
from ganlane.config.traffic import TrafficConfig
from ganlane.errors import UserError

FORMATS = ("gif", "mp4", "png")


@dataclass
class FilmConfig:
    """``film``: which part of the episode, how fast, how large. s, m, pixels."""

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
            "film",
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
            raise UserError(f"film.end_s={self.end_s:g}: expected more than film.start_s={self.start_s:g}.")


@dataclass
class RenderConfig(RunConfig):
    """One episode of one agent on one traffic, as a film."""

    driver: str = "mobil"
    episode: int = 0
    format: str = "gif"
    out: str | None = None
    env: EnvConfig = field(default_factory=EnvConfig)
    traffic: TrafficConfig = field(default_factory=TrafficConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    generator: GeneratorFile = field(default_factory=GeneratorFile)
    film: FilmConfig = field(default_factory=FilmConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "", episode=between(0, 2**53), format=one_of(FORMATS))
        check_pay(self.env, self.reward)
        if self.format == "mp4":
            require_video()
        if self.out is not None:
            _check_out(Path(self.out))
            _check_suffix(Path(self.out))


def _check_suffix(path: Path) -> None:
    """The file's name must not promise what it does not hold."""
    if path.suffix and path.suffix.removeprefix(".").lower() not in FORMATS:
        raise UserError(f"out={path}: films are {', '.join(FORMATS)}; give the file one of these endings.")


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
