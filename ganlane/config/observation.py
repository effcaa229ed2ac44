"""``observation=...``: what the agent sees, Table III and the forms of it that teach more."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ganlane.parameters.checks import check, one_of
from ganlane.parameters.observation import ObservationScale, SensorParameters
from ganlane.parameters.records import assign, part_of
from ganlane.parameters.removed import refuse_removed_observation

#: As in :data:`ganlane.transforms.OBSERVATIONS`; repeated here so that a wrong name is found without loading torch.
FORMS = (
    "table3",
    "table3_progress",
    "lane_view",
    "lane_view_drift",
    "lane_view_overlap",
    "table3_lane_view",
)


@dataclass(frozen=True)
class ObservationConfig(ObservationScale):
    """``observation=lane_view_overlap`` and the other forms (:class:`ganlane.transforms.ObservationTransform`).

    Attributes:
        form: one of :data:`FORMS`.
        sensors: None: perfect ones, for which no transform is inserted.
    """

    form: str = "lane_view_overlap"
    sensors: SensorParameters | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        # Errors of 0 everywhere are no errors: one way to say so, which is also that of configs without the key.
        if self.sensors == SensorParameters():
            assign(self, sensors=None)
        refuse_removed_observation(self.form)
        check(self, form=one_of(FORMS))

    def scale(self) -> ObservationScale:
        """The normalisers alone."""
        return part_of(self, ObservationScale)

    def read_by(self, agent: ObservationConfig | None) -> ObservationConfig:
        """What a driver reads here: the form and scale that ``agent`` names, if it does, through these sensors."""
        return self if agent is None else replace(agent, sensors=self.sensors)
