"""``data=...``: which recordings."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ganlane.errors import UserError
from ganlane.parameters.checks import Rule, at_least, check, every, one_of, optional, text

if TYPE_CHECKING:
    from ganlane.data import NgsimParameters

#: The NGSIM trajectories (doi:10.21949/1504477), as the portal of the US DOT exports them.
NGSIM_URL = "https://data.transportation.gov/api/views/8ect-6jqj/rows.csv?accessType=DOWNLOAD"
_SHA256 = Rule(lambda value: re.fullmatch(r"[0-9a-fA-F]{64}", value) is not None, "64 hexadecimal digits")
_ADDRESS = Rule(lambda value: value.startswith(("http://", "https://")), "an address that begins with https://")


@dataclass
class DataConfig:
    """``data=scenes``: scene CSV, or what ``ganlane prepare`` wrote (:func:`ganlane.data.read_scenes`).

    ``path`` null takes the US-101 scenes of the recordings' folder; ``held_out`` null holds back the scenes that the
    shipped generators hold back where they are there, else every third scene.
    """

    format: str = "scenes"
    path: str | None = None
    held_out: list[str] | None = None

    def __post_init__(self) -> None:
        formats = {DataConfig: "scenes", NgsimDataConfig: "ngsim", HighdDataConfig: "highd"}
        check(self, "data", format=one_of((formats[type(self)],)), held_out=optional(every(text())))

    def parameters(self) -> NgsimParameters | None:
        """What the reader takes besides the path; None where it takes nothing."""
        return None

    def held_out_scenes(self, scenes: Sequence[str], preferred: Sequence[str]) -> tuple[str, ...]:
        """The scenes not to fit to, of ``scenes`` in the recordings; ``preferred`` where they are all there."""
        if self.held_out is not None:
            return tuple(self.held_out)
        return tuple(preferred) if set(preferred) <= set(scenes) else tuple(sorted(scenes)[1::3])


@dataclass
class NgsimDataConfig(DataConfig):
    """``data=ngsim``: NGSIM's text files or the portal's CSV (:func:`ganlane.data.ngsim_scenes`)."""

    format: str = "ngsim"
    locations: list[str] = field(default_factory=lambda: ["us-101", "i-80"])
    lanes: int = 6
    download: bool = False
    url: str = NGSIM_URL
    sha256: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "data", locations=every(text()), lanes=at_least(1), url=_ADDRESS, sha256=optional(_SHA256))
        if self.download and self.path is None:
            raise UserError("data.download=true: where to is missing; give data.path=FILE, for instance ngsim.csv.")

    def parameters(self) -> NgsimParameters:
        """As the reader takes it."""
        from ganlane.data import NgsimParameters

        return NgsimParameters(tuple(place.lower() for place in self.locations), self.lanes)


@dataclass
class HighdDataConfig(DataConfig):
    """``data=highd``: a folder of highD recordings, or one ``XX_tracks.csv`` (:func:`ganlane.data.highd_scenes`)."""

    format: str = "highd"
