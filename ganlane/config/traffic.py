"""``traffic=...``: who drives the other vehicles.

``_target_`` names a :class:`ganlane.traffic.TrafficModule` or a function that makes one. It is called with those of
``road, stream, idm, mobil, steering, spawn`` that its signature asks for, with the option's further keys, and with
``parameters``. A model of your own needs no more than its import path::

    python -m ganlane.evaluate 'traffics=[my.module.MyTraffic]'
    python -m ganlane.train traffic=idm traffic._target_=my.module.MyTraffic +traffic.parameters.pace=0.9
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from typing import Any

from ganlane.parameters.checks import Rule, at_least, between, check, optional

_IMPORT_PATH = Rule(
    lambda path: all(part.isidentifier() for part in path.split(".")) and "." in path,
    "an import path such as my.module.MyTraffic",
)

#: The targets that have an option of their own.
NAMES = {
    "ganlane.traffic.IdmTraffic": "idm",
    "ganlane.traffic.IdmMobilTraffic": "idm_mobil",
    "ganlane.traffic.presets.gan_traffic": "gan",
    "ganlane.traffic.presets.gan_calibrated_traffic": "gan_calibrated",
    "ganlane.traffic.presets.idm_faults_traffic": "idm_faults",
    "ganlane.traffic.ReplayTraffic": "replay",
    "ganlane.traffic.SumoTraffic": "sumo",
    "ganlane.traffic.HighwayEnvTraffic": "highway_env",
    "ganlane.traffic.IdmRandomTraffic": "idm_random",
    "ganlane.traffic.MixedTraffic": "mixed",
}


@dataclass
class TrafficConfig:
    """What every traffic option has: a target, free parameters for it, and how often the others are blind to the ego.

    ``blind_share`` is the share of the episodes in which they do not see it (:class:`ganlane.traffic.BlindTraffic`).
    """

    _target_: str = "ganlane.traffic.IdmTraffic"
    parameters: dict[str, Any] = field(default_factory=dict)
    blind_share: float = 0.0

    def __post_init__(self) -> None:
        check(self, "traffic", _target_=_IMPORT_PATH, blind_share=between(0, 1))

    def label(self) -> str:
        """Name in tables: the option's, or the target's of a model of your own."""
        return NAMES.get(self._target_, self._target_)

    def arguments(self) -> dict[str, Any]:
        """Keyword arguments that this option gives its target."""
        shared = {known.name for known in fields(TrafficConfig)}
        own = {known.name: getattr(self, known.name) for known in fields(self) if known.name not in shared}
        return {**own, **self.parameters}

    def parts(self) -> dict[str, TrafficConfig]:
        """Traffics that the target is made of, by name; it is given the models made of them as ``parts``."""
        return {}

    def description(self) -> dict[str, Any]:
        """Plain data by which a run is recognised; what has no effect, and older runs do not hold, is left out."""
        described = asdict(self)
        if not self.blind_share:
            del described["blind_share"]
        return described


@dataclass
class IdmTrafficConfig(TrafficConfig):
    """``traffic=idm``: IDM, everybody keeps its lane."""


@dataclass
class IdmMobilTrafficConfig(TrafficConfig):
    """``traffic=idm_mobil``: IDM with MOBIL's lane changes."""

    _target_: str = "ganlane.traffic.IdmMobilTraffic"


@dataclass
class GanTrafficConfig(TrafficConfig):
    """``traffic=gan``: the paper's (:func:`ganlane.traffic.presets.gan_traffic`); ``path`` null: shipped weights."""

    _target_: str = "ganlane.traffic.presets.gan_traffic"
    path: str | None = None
    guard: bool = True
    noise_scale: float = 1.0
    execute_k: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "traffic", noise_scale=at_least(0), execute_k=between(1, 8))


@dataclass
class GanCalibratedTrafficConfig(TrafficConfig):
    """``traffic=gan_calibrated`` (:func:`ganlane.traffic.presets.gan_calibrated_traffic`)."""

    _target_: str = "ganlane.traffic.presets.gan_calibrated_traffic"
    path: str | None = None
    noise_scale: float = 1.4
    noise_period_s: float = 3.0
    changes_per_km: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        rules = {"noise_scale": at_least(0), "noise_period_s": at_least(0), "changes_per_km": optional(at_least(0))}
        check(self, "traffic", **rules)
