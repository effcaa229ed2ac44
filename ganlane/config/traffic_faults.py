"""``traffic=idm_faults``: how often the drivers err, and how badly."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from ganlane.config.plain import plain_copy
from ganlane.config.traffic import TrafficConfig
from ganlane.parameters.checks import Rule, above, at_least, between, check

if TYPE_CHECKING:
    from ganlane.traffic.presets import DriverFaults

_PACE = Rule(lambda value: 0 < value <= 1, "a number above 0, at most 1")


@dataclass
class BrakingFaultsConfig:
    """``traffic.phantom_braking``: see :class:`ganlane.traffic.BrakingFaults`."""

    per_hour: float = 6.0
    deceleration: float = 4.0
    lasts_s: float = 1.0

    def __post_init__(self) -> None:
        where = "traffic.phantom_braking"
        check(self, where, per_hour=at_least(0), deceleration=above(0), lasts_s=at_least(0.1))


@dataclass
class ReactionFaultsConfig:
    """``traffic.late_reaction``: see :class:`ganlane.traffic.ReactionFaults`."""

    per_hour: float = 12.0
    delay_s: float = 0.8
    lasts_s: float = 5.0

    def __post_init__(self) -> None:
        where = "traffic.late_reaction"
        check(self, where, per_hour=at_least(0), delay_s=at_least(0.1), lasts_s=at_least(0.1))


@dataclass
class HesitationFaultsConfig:
    """``traffic.hesitant_change``: see :class:`ganlane.traffic.HesitationFaults`."""

    share: float = 0.2
    pace: float = 0.5

    def __post_init__(self) -> None:
        check(self, "traffic.hesitant_change", share=between(0, 1), pace=_PACE)


@dataclass
class AbortFaultsConfig:
    """``traffic.aborted_change``: see :class:`ganlane.traffic.AbortFaults`."""

    share: float = 0.1
    at: float = 0.5

    def __post_init__(self) -> None:
        check(self, "traffic.aborted_change", share=between(0, 1), at=between(0, 1))


@dataclass
class IdmFaultsTrafficConfig(TrafficConfig):
    """``traffic=idm_faults`` (:func:`ganlane.traffic.presets.idm_faults_traffic`)."""

    _target_: str = "ganlane.traffic.presets.idm_faults_traffic"
    phantom_braking: BrakingFaultsConfig = field(default_factory=BrakingFaultsConfig)
    late_reaction: ReactionFaultsConfig = field(default_factory=ReactionFaultsConfig)
    hesitant_change: HesitationFaultsConfig = field(default_factory=HesitationFaultsConfig)
    aborted_change: AbortFaultsConfig = field(default_factory=AbortFaultsConfig)

    def faults(self) -> DriverFaults:
        """The faults as the traffic takes them."""
        from ganlane.traffic import AbortFaults, BrakingFaults, HesitationFaults, ReactionFaults
        from ganlane.traffic.presets import DriverFaults

        return DriverFaults(
            plain_copy(self.phantom_braking, BrakingFaults),
            plain_copy(self.late_reaction, ReactionFaults),
            plain_copy(self.hesitant_change, HesitationFaults),
            plain_copy(self.aborted_change, AbortFaults),
        )

    def arguments(self) -> dict[str, Any]:
        """All faults as one argument."""
        return {"faults": self.faults(), **self.parameters}
