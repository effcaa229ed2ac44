"""``observation=...``: what the agent sees, Table III and the forms of it that teach more."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from ganlane.config.plain import plain_copy
from ganlane.parameters.checks import above, at_least, between, check, one_of

if TYPE_CHECKING:
    from ganlane.transforms.sensors import SensorParameters
    from ganlane.transforms.table3 import ObservationScale

#: As in :data:`ganlane.transforms.OBSERVATIONS`; repeated here so that a wrong name is found without loading torch.
FORMS = (
    "table3",
    "table3_progress",
    "lane_view",
    "lane_view_drift",
    "lane_view_overlap",
    "table3_lane_view",
    "fixed_order",
)
#: Those laid out as Table III is, from one vehicle to the next: what ``agent.encoder=shared`` can read.
LISTS = ("table3", "table3_progress", "fixed_order")


@dataclass
class SensorsConfig:
    """``observation.sensors``: errors in what the ego perceives (:class:`ganlane.transforms.SensorParameters`)."""

    position_noise_m: float = 0.0
    lateral_noise_m: float = 0.0
    speed_noise_mps: float = 0.0
    dropout: float = 0.0
    delay_s: float = 0.0

    def __post_init__(self) -> None:
        sizes = ("position_noise_m", "lateral_noise_m", "speed_noise_mps", "delay_s")
        check(self, "observation.sensors", dropout=between(0, 1), **dict.fromkeys(sizes, at_least(0)))


@dataclass
class ObservationConfig:
    """``observation=lane_view_overlap`` and the other forms (:class:`ganlane.transforms.ObservationTransform`)."""

    form: str = "lane_view_overlap"
    range_m: float = 200.0
    speed_mps: float = 30.0
    #: None: perfect sensors, for which no transform is inserted.
    sensors: SensorsConfig | None = None

    def __post_init__(self) -> None:
        # Errors of 0 everywhere are no errors: one way to say so, which is also that of configs without the key.
        if self.sensors == SensorsConfig():
            self.sensors = None
        check(self, "observation", form=one_of(FORMS), range_m=above(0), speed_mps=above(0))

    def scale(self) -> ObservationScale:
        """The normalisers as the transform takes them."""
        from ganlane.transforms.table3 import ObservationScale

        return plain_copy(self, ObservationScale)

    def read_by(self, agent: ObservationConfig | None) -> ObservationConfig:
        """What a driver reads here: the form and scale that ``agent`` names, if it does, through these sensors."""
        return self if agent is None else replace(agent, sensors=self.sensors)

    def sensor_parameters(self) -> SensorParameters | None:
        """The sensors' errors as the transform takes them; None where there are none."""
        from ganlane.transforms.sensors import SensorParameters

        return None if self.sensors is None else plain_copy(self.sensors, SensorParameters)
