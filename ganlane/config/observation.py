"""``observation=...``: what the agent sees, Table III and the forms of it that teach more."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ganlane.config.checks import above, check, one_of
from ganlane.config.plain import plain_copy

if TYPE_CHECKING:
    from ganlane.transforms.table3 import ObservationScale

#: As in :data:`ganlane.transforms.OBSERVATIONS`; repeated here so that a wrong name is found without loading torch.
FORMS = ("table3", "table3_progress", "lane_view", "table3_lane_view")


@dataclass
class ObservationConfig:
    """``observation=lane_view`` and the other forms (:class:`ganlane.transforms.ObservationTransform`)."""

    form: str = "lane_view"
    range_m: float = 200.0
    speed_mps: float = 30.0

    def __post_init__(self) -> None:
        check(self, "observation", form=one_of(FORMS), range_m=above(0), speed_mps=above(0))

    def scale(self) -> ObservationScale:
        """The normalisers as the transform takes them."""
        from ganlane.transforms.table3 import ObservationScale

        return plain_copy(self, ObservationScale)
