"""``traffic=sumo`` and ``traffic=highway_env``: the others are driven by a foreign simulator."""

from __future__ import annotations

from dataclasses import dataclass

from ganlane.config.traffic import TrafficConfig
from ganlane.parameters.checks import at_least, between, check


@dataclass
class SumoTrafficConfig(TrafficConfig):
    """``traffic=sumo`` (:class:`ganlane.traffic.SumoTraffic`)."""

    _target_: str = "ganlane.traffic.SumoTraffic"
    truck_share: float = 0.15
    truck_length_m: float = 12.0
    lane_change_s: float = 4.0
    keep_right: float = 1.0
    speed_wander: float = 0.03

    def __post_init__(self) -> None:
        super().__post_init__()
        rules = {
            "truck_share": between(0, 1),
            "truck_length_m": between(4.5, 25),
            # Faster than this, a change looks like a jump.
            "lane_change_s": at_least(1),
            "keep_right": at_least(0),
            "speed_wander": between(0, 0.2),
        }
        check(self, "traffic", **rules)


@dataclass
class HighwayEnvTrafficConfig(TrafficConfig):
    """``traffic=highway_env`` (:class:`ganlane.traffic.HighwayEnvTraffic`)."""

    _target_: str = "ganlane.traffic.HighwayEnvTraffic"
