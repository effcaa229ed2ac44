"""``traffic=...``: who drives the other vehicles.

``_target_`` names a :class:`ganlane.traffic.TrafficModule` or a function annotated to return one.
It is called with those of ``road, stream, idm, mobil, steering, spawn`` that its signature asks
for, with the option's further keys and with ``parameters``. A model of your own needs no more than
its import path::

    python -m ganlane.evaluate 'traffics=[my.module.MyTraffic]'
    python -m ganlane.train traffic=idm traffic._target_=my.module.MyTraffic +traffic.parameters.pace=0.9

The numbers of each option are declared in :mod:`ganlane.parameters.driving`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Annotated, Any, TypeAlias

from ganlane.arguments import is_import_path
from ganlane.errors import ParameterError
from ganlane.parameters import Record, Rule, Share, assign, did_you_mean, part_of
from ganlane.parameters.driving import (
    CalibratedGanParameters,
    DriverFaults,
    GanParameters,
    RandomDrivers,
    ReplayParameters,
    SumoParameters,
)

ImportPath: TypeAlias = Annotated[
    str, Rule(is_import_path, "an import path such as my.module.MyTraffic")
]
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
#: The shares of a mixture where none are given.
SHARES = {"idm_mobil": 1, "gan": 1}


@dataclass(frozen=True)
class TrafficConfig(Record):
    """What every traffic option has.

    Attributes:
        _target_: a TrafficModule of your own, or a function that makes one, may be named here.
        parameters: keyword arguments for a model of your own.
        blind_share: share of the episodes, 0 to 1, in which the others do not see the ego at all.
    """

    _target_: ImportPath = "ganlane.traffic.IdmTraffic"
    parameters: dict[str, Any] = field(default_factory=dict)
    blind_share: Share = 0.0

    def label(self) -> str:
        """Name in tables: the option's, or the target's of a model of your own."""
        options = {kind._target_: name for name, kind in TRAFFICS.items()}
        return options.get(self._target_, self._target_)

    def arguments(self) -> dict[str, Any]:
        """Keyword arguments that this option gives its target."""
        shared = {known.name for known in fields(TrafficConfig)}
        own = {
            known.name: getattr(self, known.name)
            for known in fields(self)
            if known.name not in shared
        }
        return {**own, **self.parameters}

    def parts(self) -> dict[str, TrafficConfig]:
        """Traffics that the target is made of, by name.

        It is given the models made of them as ``parts``.
        """
        return {}

    def description(self) -> dict[str, Any]:
        """Plain data by which a run is recognised.

        What has no effect, and older runs do not hold, is left out.
        """
        described = _listed(asdict(self))
        if not self.blind_share:
            del described["blind_share"]
        return described


def _listed(value: Any) -> Any:
    """``value`` with lists in place of tuples, as older runs have them."""
    if isinstance(value, dict):
        return {name: _listed(each) for name, each in value.items()}
    return [_listed(each) for each in value] if isinstance(value, list | tuple) else value


@dataclass(frozen=True)
class IdmTrafficConfig(TrafficConfig):
    """``traffic=idm``: IDM, everybody keeps its lane."""


@dataclass(frozen=True)
class IdmMobilTrafficConfig(TrafficConfig):
    """``traffic=idm_mobil``: IDM with MOBIL's lane changes."""

    _target_: str = "ganlane.traffic.IdmMobilTraffic"


@dataclass(frozen=True)
class GanTrafficConfig(TrafficConfig, GanParameters):
    """``traffic=gan`` (:func:`ganlane.traffic.presets.gan_traffic`)."""

    _target_: str = "ganlane.traffic.presets.gan_traffic"


@dataclass(frozen=True)
class GanCalibratedTrafficConfig(TrafficConfig, CalibratedGanParameters):
    """``traffic=gan_calibrated`` (:func:`ganlane.traffic.presets.gan_calibrated_traffic`)."""

    _target_: str = "ganlane.traffic.presets.gan_calibrated_traffic"


@dataclass(frozen=True)
class IdmFaultsTrafficConfig(TrafficConfig, DriverFaults):
    """``traffic=idm_faults`` (:func:`ganlane.traffic.presets.idm_faults_traffic`)."""

    _target_: str = "ganlane.traffic.presets.idm_faults_traffic"

    def arguments(self) -> dict[str, Any]:
        """All faults as one argument."""
        return {"faults": part_of(self, DriverFaults), **self.parameters}


@dataclass(frozen=True)
class IdmRandomTrafficConfig(TrafficConfig, RandomDrivers):
    """``traffic=idm_random`` (:class:`ganlane.traffic.IdmRandomTraffic`)."""

    _target_: str = "ganlane.traffic.IdmRandomTraffic"

    def arguments(self) -> dict[str, Any]:
        """All ranges as one argument."""
        return {"drivers": part_of(self, RandomDrivers), **self.parameters}


@dataclass(frozen=True)
class SumoTrafficConfig(TrafficConfig, SumoParameters):
    """``traffic=sumo`` (:class:`ganlane_simulators.SumoTraffic`)."""

    _target_: str = "ganlane_simulators.SumoTraffic"


@dataclass(frozen=True)
class HighwayEnvTrafficConfig(TrafficConfig):
    """``traffic=highway_env`` (:class:`ganlane_simulators.HighwayEnvTraffic`)."""

    _target_: str = "ganlane_simulators.HighwayEnvTraffic"


@dataclass(frozen=True)
class ReplayTrafficConfig(TrafficConfig, ReplayParameters):
    """``traffic=replay`` (:class:`ganlane.traffic.ReplayTraffic`)."""

    _target_: str = "ganlane.traffic.ReplayTraffic"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.blind_share:
            raise ParameterError(
                f"{{blind_share}}={self.blind_share:g} with replayed traffic: recorded vehicles see no ego anyway; "
                "leave it out."
            )


#: The options whose drivers react: what a mixture may hold.
REACTING: dict[str, type[TrafficConfig]] = {
    "idm": IdmTrafficConfig,
    "idm_mobil": IdmMobilTrafficConfig,
    "gan": GanTrafficConfig,
    "gan_calibrated": GanCalibratedTrafficConfig,
    "idm_faults": IdmFaultsTrafficConfig,
    "idm_random": IdmRandomTrafficConfig,
}


@dataclass(frozen=True)
class MixedTrafficConfig(TrafficConfig):
    """``traffic=mixed`` (:class:`ganlane.traffic.MixedTraffic`).

    ``shares`` is null rather than its value, and of a free type, since a YAML file would add to
    names that are there. A command line replaces them
    (:func:`ganlane.config.command_line.with_shares_replaced`).

    Attributes:
        shares: options of this group (not replay), or import paths of your own models, with whole
            numbers: how many of the episodes of a period belong to each; null: {idm_mobil: 1, gan:
            1}.
        options: the parts' keys: traffic.options.gan.noise_scale=0.5.
    """

    _target_: str = "ganlane.traffic.MixedTraffic"
    shares: Annotated[Any, _SHARES] = None
    options: dict[str, TrafficConfig] = field(
        default_factory=lambda: {name: kind() for name, kind in REACTING.items()}
    )

    def __post_init__(self) -> None:
        assign(self, shares=dict(SHARES) if self.shares is None else self.shares)
        super().__post_init__()
        self.parts()

    def parts(self) -> dict[str, TrafficConfig]:
        """The traffics of the mixture, by name.

        Raises:
            UserError: one of them is not known, or plays recordings.
        """
        without = {"replay": "plays recordings on roads of its own", "mixed": "is a mixture itself"}
        for name in self.shares:
            label = self.options[name].label() if name in self.options else name
            if label in without:
                raise ParameterError(f"{{shares}}={name}: it {without[label]}; leave it out.")
        return chosen_traffics("shares", self.shares, self.options)

    def arguments(self) -> dict[str, Any]:
        """The shares; the parts are made by who makes the traffic."""
        return {"shares": dict(self.shares), **self.parameters}

    def description(self) -> dict[str, Any]:
        """As of every traffic, with the options of those parts alone that have a share."""
        used = {name: part.description() for name, part in self.parts().items()}
        return {**super().description(), "options": used}


#: The options of the group ``traffic``.
TRAFFICS: dict[str, type[TrafficConfig]] = {
    **REACTING,
    "mixed": MixedTrafficConfig,
    "replay": ReplayTrafficConfig,
    "sumo": SumoTrafficConfig,
    "highway_env": HighwayEnvTrafficConfig,
}


def all_traffics() -> dict[str, TrafficConfig]:
    """The options of the group ``traffic`` with their defaults, by name."""
    return {name: kind() for name, kind in TRAFFICS.items()}


def chosen_traffics(
    key: str, names: Iterable[str], options: Mapping[str, TrafficConfig], own: bool = True
) -> dict[str, TrafficConfig]:
    """The traffics of these names: ``options``, or (``own``) the import paths of a user's own
    models.

    Raises:
        ParameterError: one is not known; ``key`` is the field that names it.
    """
    for name in names:
        if name not in options and not (own and "." in name):
            further = ", or give the import path of a model of your own" if own else ""
            raise ParameterError(
                f"{{{key}}}={name}: no such traffic{did_you_mean(name, options)}; choose among "
                f"{', '.join(options)}{further}."
            )
    return {name: options.get(name) or TrafficConfig(_target_=name) for name in names}
