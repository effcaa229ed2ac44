"""``data=...``: which recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ganlane.config.checks import check, every, one_of, optional, text


@dataclass
class DataConfig:
    """``data=scenes``: scene CSV (:func:`ganlane.data.read_scenes`).

    ``path`` null takes the US-101 scenes of the recordings' folder; ``held_out`` null holds back the scenes that the
    shipped generators hold back where they are there, else every third scene.
    """

    format: str = "scenes"
    path: str | None = None
    held_out: list[str] | None = None

    def __post_init__(self) -> None:
        check(self, "data", format=one_of(("scenes",)), held_out=optional(every(text())))

    def held_out_scenes(self, scenes: Sequence[str], preferred: Sequence[str]) -> tuple[str, ...]:
        """The scenes not to fit to, of ``scenes`` in the recordings; ``preferred`` where they are all there."""
        if self.held_out is not None:
            return tuple(self.held_out)
        return tuple(preferred) if set(preferred) <= set(scenes) else tuple(sorted(scenes)[1::3])
