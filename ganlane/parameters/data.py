"""Recordings: where they are, in which format, and which of them are held out."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

from ganlane.errors import ParameterError
from ganlane.parameters.checks import NO_KEY, Count, Record, Rule, Text, assign, part_of

#: The NGSIM trajectories (doi:10.21949/1504477), as the portal of the US DOT exports them.
NGSIM_URL = "https://data.transportation.gov/api/views/8ect-6jqj/rows.csv?accessType=DOWNLOAD"
#: Bytes of a file that are read at once: about 300,000 rows of NGSIM, which take a few times as much memory.
BLOCK_BYTES = 32 * 2**20
#: NGSIM's locations without crossings.
MOTORWAYS = ("us-101", "i-80")
_SHA256 = Rule(lambda value: re.fullmatch(r"[0-9a-fA-F]{64}", value) is not None, "64 hexadecimal digits")
_ADDRESS = Rule(lambda value: value.startswith(("http://", "https://")), "an address that begins with https://")


@dataclass(frozen=True)
class NgsimParameters(Record):
    """Which rows of an NGSIM file are read.

    Attributes:
        locations: places to keep, where the file names them; lankershim and peachtree have crossings.
        lanes: number of lanes kept, counted from the left; on US-101 and I-80 lanes 1 to 6 are the main lanes (and
            US-101's auxiliary lane), higher numbers are ramps.
        block_bytes: bytes read at once.
    """

    locations: tuple[Text, ...] = MOTORWAYS
    lanes: Count = 6
    block_bytes: Count = field(default=BLOCK_BYTES, metadata=NO_KEY)

    def __post_init__(self) -> None:
        super().__post_init__()
        assign(self, locations=tuple(place.lower() for place in self.locations))


@dataclass(frozen=True)
class DataConfig(Record):
    """``data=scenes``: scene CSV, or what ``ganlane prepare`` wrote (:func:`ganlane.data.read_scenes`).

    Attributes:
        format: chosen with the option: ``data=ngsim``.
        path: file or folder; null: US-101 below GANLANE_DATA or ../shared/data.
        held_out: names of scenes not to fit to; null: those of the shipped weights, else every third scene.
    """

    format: str = "scenes"
    path: str | None = None
    held_out: tuple[Text, ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.format != type(self).format:
            raise ParameterError(f"{{format}}={self.format}: expected {type(self).format}; choose data=NAME.")

    def parameters(self) -> NgsimParameters | None:
        """Further inputs of the reader; None where it takes nothing."""
        return None

    def held_out_scenes(self, scenes: Sequence[str], preferred: Sequence[str]) -> tuple[str, ...]:
        """The scenes not to fit to, of ``scenes`` in the recordings; ``preferred`` where they are all there."""
        if self.held_out is not None:
            return self.held_out
        return tuple(preferred) if set(preferred) <= set(scenes) else tuple(sorted(scenes)[1::3])


@dataclass(frozen=True)
class NgsimDataConfig(NgsimParameters, DataConfig):
    """``data=ngsim``: NGSIM's text files or the portal's CSV (:func:`ganlane.data.ngsim_scenes`).

    Attributes:
        path: the file; with download=true, where to put it.
        held_out: names of scenes not to fit to.
        download: true: fetch the file first, unless it is there; an interrupted transfer continues.
        url: from where.
        sha256: checksum of the file, 64 hexadecimal digits; another file is refused.
    """

    format: str = "ngsim"
    download: bool = False
    url: Annotated[str, _ADDRESS] = NGSIM_URL
    sha256: Annotated[str, _SHA256] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.download and self.path is None:
            raise ParameterError("{download}=true: where to is missing; give {path}=FILE, for instance ngsim.csv.")

    def parameters(self) -> NgsimParameters:
        """As the reader takes it."""
        return part_of(self, NgsimParameters)


@dataclass(frozen=True)
class HighdDataConfig(DataConfig):
    """``data=highd``: a folder of highD recordings, or one ``XX_tracks.csv`` (:func:`ganlane.data.highd_scenes`).

    Attributes:
        path: the folder, or one XX_tracks.csv.
        held_out: names of scenes not to fit to.
    """

    format: str = "highd"
