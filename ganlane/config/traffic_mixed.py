"""``traffic=mixed``: several traffics, and which share of the episodes each has."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ganlane.config.traffic import (
    GanCalibratedTrafficConfig,
    GanTrafficConfig,
    IdmMobilTrafficConfig,
    IdmTrafficConfig,
    TrafficConfig,
)
from ganlane.config.traffic_faults import IdmFaultsTrafficConfig
from ganlane.config.traffic_random import IdmRandomTrafficConfig
from ganlane.errors import UserError
from ganlane.parameters.checks import Rule, check, did_you_mean

#: A larger sum would be a period of more episodes than anybody drives side by side.
_MOST = 1000
_SHARES = Rule(
    lambda shares: (
        isinstance(shares, dict)
        and len(shares) > 0
        and all(type(share) is int and share >= 1 for share in shares.values())
        and sum(shares.values()) <= _MOST
    ),
    f"names of traffics with whole numbers of at least 1, not above {_MOST} together",
)
#: The shares where none are given.
SHARES = {"idm_mobil": 1, "gan": 1}
_NOT_MIXED = ("replay", "mixed")


def reacting_traffics() -> dict[str, TrafficConfig]:
    """The options of the group ``traffic`` whose drivers react, by name: what a mixture may hold."""
    return {
        "idm": IdmTrafficConfig(),
        "idm_mobil": IdmMobilTrafficConfig(),
        "gan": GanTrafficConfig(),
        "gan_calibrated": GanCalibratedTrafficConfig(),
        "idm_faults": IdmFaultsTrafficConfig(),
        "idm_random": IdmRandomTrafficConfig(),
    }


@dataclass
class MixedTrafficConfig(TrafficConfig):
    """``traffic=mixed`` (:class:`ganlane.traffic.MixedTraffic`).

    ``shares``: by the name of an option, or the import path of a model of one's own, how many of the episodes of a
    period belong to it; null means :data:`SHARES` (a command line would add to names that stand there; for the same
    reason the type is free). ``options``: the keys of the parts, by the same names.
    """

    _target_: str = "ganlane.traffic.MixedTraffic"
    shares: Any = None
    options: dict[str, TrafficConfig] = field(default_factory=reacting_traffics)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.shares = dict(SHARES) if self.shares is None else self.shares
        check(self, "traffic", shares=_SHARES)
        self.parts()

    def parts(self) -> dict[str, TrafficConfig]:
        """The traffics of the mixture, by name.

        Raises:
            UserError: one of them is not known, or plays recordings.
        """
        shares = self.shares or {}
        for name in shares:
            chosen = self.options.get(name)
            if name in _NOT_MIXED or (chosen is not None and chosen.label() in _NOT_MIXED):
                what = "plays recordings on roads of its own" if name == "replay" else "is a mixture itself"
                raise UserError(f"traffic.shares={name}: it {what}; leave it out.")
            if chosen is None and "." not in name:
                known = ", ".join(self.options)
                raise UserError(
                    f"traffic.shares={name}: no such traffic{did_you_mean(name, self.options)}; choose among "
                    f"{known}, or give the import path of a model of your own."
                )
        return {name: self.options.get(name) or TrafficConfig(_target_=name) for name in shares}

    def arguments(self) -> dict[str, Any]:
        """The shares; the parts are made by who makes the traffic."""
        return {"shares": dict(self.shares or {}), **self.parameters}

    def description(self) -> dict[str, Any]:
        """As of every traffic, with the options of those parts alone that have a share."""
        used = {name: part.description() for name, part in self.parts().items()}
        return {**super().description(), "options": used}
