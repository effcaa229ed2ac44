"""``traffic=replay``: which recordings are played."""

from __future__ import annotations

from dataclasses import dataclass

from ganlane.config.traffic import TrafficConfig
from ganlane.errors import UserError
from ganlane.parameters.checks import at_least, check


@dataclass
class ReplayTrafficConfig(TrafficConfig):
    """``traffic=replay`` (:class:`ganlane.traffic.ReplayTraffic`); ``path`` null: the recordings' folder."""

    _target_: str = "ganlane.traffic.ReplayTraffic"
    path: str | None = None
    least_s: float = 4.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "traffic", least_s=at_least(0.1))
        if self.blind_share:
            raise UserError(
                f"traffic.blind_share={self.blind_share:g} with replayed traffic: recorded vehicles see no ego "
                "anyway; leave it out."
            )
