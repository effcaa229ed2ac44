"""``traffic=idm_random``: the ranges that drivers' parameters are drawn from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from ganlane.config.plain import plain_copy
from ganlane.config.traffic import TrafficConfig
from ganlane.parameters.checks import Rule, check, speed_range

if TYPE_CHECKING:
    from ganlane.traffic import RandomDrivers

_FROM_0 = Rule(speed_range().holds, "two numbers [low, high], 0 <= low <= high")
_POSITIVE = Rule(lambda value: _FROM_0.holds(value) and value[0] > 0, "two numbers [low, high], 0 < low <= high")
_REACTION = Rule(
    lambda value: _FROM_0.holds(value) and value[1] <= 3, "two numbers [low, high], 0 <= low <= high <= 3"
)


@dataclass
class IdmRandomTrafficConfig(TrafficConfig):
    """``traffic=idm_random``: the ranges of :class:`ganlane.traffic.RandomDrivers`."""

    _target_: str = "ganlane.traffic.IdmRandomTraffic"
    headway_s: list[float] = field(default_factory=lambda: [0.8, 2.2])
    max_acceleration: list[float] = field(default_factory=lambda: [0.6, 1.6])
    comfortable_deceleration: list[float] = field(default_factory=lambda: [1.2, 2.5])
    strongest_braking: list[float] = field(default_factory=lambda: [4.0, 9.0])
    desired_speed: list[float] = field(default_factory=lambda: [0.9, 1.1])
    politeness: list[float] = field(default_factory=lambda: [0.0, 1.0])
    reaction_s: list[float] = field(default_factory=lambda: [0.0, 0.6])
    sway_m: list[float] = field(default_factory=lambda: [0.0, 0.25])
    sway_period_s: list[float] = field(default_factory=lambda: [8.0, 20.0])

    def __post_init__(self) -> None:
        super().__post_init__()
        positive = ("max_acceleration", "comfortable_deceleration", "strongest_braking", "desired_speed")
        check(
            self,
            "traffic",
            **dict.fromkeys((*positive, "sway_period_s"), _POSITIVE),
            **dict.fromkeys(("headway_s", "politeness", "sway_m"), _FROM_0),
            reaction_s=_REACTION,
        )

    def drivers(self) -> RandomDrivers:
        """The ranges as the traffic takes them."""
        from ganlane.traffic import RandomDrivers

        return plain_copy(self, RandomDrivers)

    def arguments(self) -> dict[str, Any]:
        """All ranges as one argument."""
        return {"drivers": self.drivers(), **self.parameters}
