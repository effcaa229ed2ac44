"""``traffic=...``: who drives the other vehicles.

``_target_`` names a :class:`ganlane.traffic.TrafficModule` or a function annotated to return one.
It is called with those of ``road, stream, idm, mobil, steering, spawn`` that its signature asks
for, and with the record's further keys. A model of your own needs no more than its import path::

    ganlane evaluate 'traffics=[my.module.MyTraffic]'
    ganlane train traffic=idm traffic._target_=my.module.MyTraffic traffic.pace=0.9
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

from ganlane.arguments import is_import_path
from ganlane.errors import ParameterError
from ganlane.settings.driving import DriverFaults, HumanVariation, RandomDrivers, Steps
from ganlane.settings.record import (
    NotNegative,
    Record,
    Rule,
    Share,
    at_least,
    between,
    key_names,
    make,
    part_of,
)

ImportPath = Annotated[str, Rule(is_import_path, "an import path such as my.module.MyTraffic")]
#: A larger sum would be a period of more episodes than anybody drives side by side.
MOST_SHARES = 1000
_SHARES = Rule(
    lambda shares: len(shares) > 0 and sum(shares.values()) <= MOST_SHARES,
    f"names of traffics with whole numbers of at least 1, not above {MOST_SHARES} together",
)


@dataclass(frozen=True)
class TrafficConfig(Record):
    """What every traffic has; a traffic of this package is a subclass with its own parameters.

    Attributes:
        _target_: a TrafficModule, or a function that makes one; yours may be named here.
        blind_share: share of the episodes, 0 to 1, in which the others do not see the ego at all.
    """

    group = "traffic"
    chosen_by = "_target_"
    #: Name of the option, in tables.
    option: ClassVar[str] = ""

    _target_: ImportPath
    blind_share: Share = 0.0

    @classmethod
    def chosen(cls, data: Any) -> tuple[type[Record], Any]:
        """The record of the target; of one that is not known here all further keys are its own.

        ``data`` may also be a class or an import path, alone or as the mapping's ``name``.
        """
        # A class, its import path, an option's name: all become the mapping with _target_.
        if isinstance(data, str) or inspect.isclass(data):
            data = {"name": data}
        # What is no mapping goes to the base class, which says what is wrong with it.
        if not isinstance(data, Mapping):
            return super().chosen(data)
        name = data.get("name")
        if inspect.isclass(name):
            name = f"{name.__module__}.{name.__qualname__}"
        if "." in str(name):
            others = {key: value for key, value in data.items() if key != "name"}
            data = {"_target_": name, **others}
        if not {"_target_", "name"} & set(data):
            raise ParameterError(
                "{_target_}: of which traffic? name it first, as in traffic=gan or "
                "pretrain.traffic=gan."
            )
        target = data.get("_target_")
        if not isinstance(target, str) or target in cls.kinds():
            return super().chosen(data)
        # A model of your own: what is no key of every traffic is an argument of its constructor.
        # The saved configuration of a run has them below arguments_ already.
        shared = {name: data[name] for name in key_names(TrafficConfig) if name in data}
        stored = data.get("arguments_")
        arguments = {name: value for name, value in data.items() if name not in shared}
        return OwnTraffic, {**shared, "arguments_": arguments if stored is None else stored}

    def label(self) -> str:
        """Name in tables: the option's, or the import path of a model of your own."""
        return self.option or self._target_

    def arguments(self) -> dict[str, Any]:
        """Keyword arguments of the target: the fields that not every traffic has."""
        # Target and blind_share are for whoever makes the traffic, not for the target.
        shared = key_names(TrafficConfig)
        names = [name for name in key_names(type(self)) if name not in shared]
        return {name: getattr(self, name) for name in names}

    def parts(self) -> dict[str, TrafficConfig]:
        """Traffics that the target is made of, by name; it is given their models as ``parts``."""
        return {}


@dataclass(frozen=True)
class OwnTraffic(TrafficConfig):
    """A model of your own.

    Attributes:
        arguments_: keyword arguments of its constructor.
    """

    # A default, since kinds() reads it from the class; no import path is empty.
    _target_: ImportPath = ""
    # With an underscore, since arguments() is a method.
    arguments_: dict[str, Any] = field(default_factory=dict)

    def arguments(self) -> dict[str, Any]:
        """All further keys."""
        return dict(self.arguments_)


@dataclass(frozen=True)
class IdmTrafficConfig(TrafficConfig):
    """``traffic=idm``: IDM, everybody keeps its lane."""

    option = "idm"
    _target_: ImportPath = "ganlane.traffic.IdmTraffic"


@dataclass(frozen=True)
class IdmMobilTrafficConfig(TrafficConfig):
    """``traffic=idm_mobil``: IDM with MOBIL's lane changes."""

    option = "idm_mobil"
    _target_: ImportPath = "ganlane.traffic.IdmMobilTraffic"


@dataclass(frozen=True)
class GanTrafficConfig(TrafficConfig):
    """``traffic=gan``: the paper's generated traffic (:mod:`ganlane.traffic.presets`).

    Attributes:
        path: weights of the preset 'paper'; null: the ones that ship.
        guard: false: without it vehicles leave the road within a minute.
        noise_scale: 1 samples trajectories as fitted, 0 takes the mean prediction.
    """

    option = "gan"
    _target_: ImportPath = "ganlane.traffic.presets.gan_traffic"
    path: str | None = None
    # the network knows no lanes, so something else has to keep vehicles on the road
    guard: bool = True
    noise_scale: NotNegative = 1.0


@dataclass(frozen=True)
class GanCalibratedTrafficConfig(TrafficConfig):
    """``traffic=gan_calibrated``: generated traffic, calibrated (:mod:`ganlane.traffic.presets`).

    The two numbers of the noise were chosen on the scenes that the generator is fitted to: as
    fitted (1 and 5 s) too few drivers accelerate.

    Attributes:
        path: weights of the preset 'calibrated'; null: the ones that ship.
        noise_scale: of the latent vectors; 1 as fitted, 0 drives everybody by the mean prediction.
        noise_period_s: time in which a driver's latent vector is forgotten, s; 5 in fitting, 0: at
            once.
        changes_per_km: wishes for a lane change per vehicle-km; null: from the recordings.
    """

    option = "gan_calibrated"
    _target_: ImportPath = "ganlane.traffic.presets.gan_calibrated_traffic"
    path: str | None = None
    # chosen in simulation, not as fitted (see above)
    noise_scale: NotNegative = 1.4
    noise_period_s: NotNegative = 3.0
    changes_per_km: NotNegative | None = None


@dataclass(frozen=True)
class HumanTrafficConfig(TrafficConfig, HumanVariation):
    """``traffic=human``: a policy fitted to recorded drivers (:mod:`ganlane.traffic.human`).

    Attributes:
        path: weights of the preset 'human'; null: the ones that ship.
    """

    option = "human"
    _target_: ImportPath = "ganlane.traffic.presets.human_traffic"
    path: str | None = None


@dataclass(frozen=True)
class IdmFaultsTrafficConfig(TrafficConfig, DriverFaults):
    """``traffic=idm_faults``: idm_mobil with driver errors (:mod:`ganlane.traffic.faults`)."""

    option = "idm_faults"
    _target_: ImportPath = "ganlane.traffic.presets.idm_faults_traffic"

    def arguments(self) -> dict[str, Any]:
        """All faults as one argument."""
        # The keys are flat for the command line; the function takes one record.
        return {"faults": part_of(self, DriverFaults)}


@dataclass(frozen=True)
class IdmRandomTrafficConfig(TrafficConfig, RandomDrivers):
    """``traffic=idm_random``: no two drivers alike (:mod:`ganlane.traffic.idm_mobil`)."""

    option = "idm_random"
    _target_: ImportPath = "ganlane.traffic.IdmRandomTraffic"

    def arguments(self) -> dict[str, Any]:
        """All ranges as one argument."""
        return {"drivers": part_of(self, RandomDrivers)}


def interleaved(shares: Mapping[str, int]) -> list[str]:
    """The part of each of ``sum(shares)`` successive episodes, spread as evenly as possible.

    ``{a: 2, b: 1}`` gives a, b, a: in every episode each part gains its share, the one with the
    most (the first of several) is chosen and pays the sum.
    """
    # Smooth weighted round robin, as load balancers use it.
    credit = dict.fromkeys(shares, 0)
    turns = []
    for _ in range(sum(shares.values())):
        for name, share in shares.items():
            credit[name] += share
        # The first of several, so the order of the shares decides.
        chosen = max(credit, key=lambda name: credit[name])
        credit[chosen] -= sum(shares.values())
        turns.append(chosen)
    return turns


@dataclass(frozen=True)
class MixedTrafficConfig(TrafficConfig):
    """``traffic=mixed``: every episode belongs to one of several traffics, in turns.

    Attributes:
        shares: options of this group (not replay), or import paths of your own models, with whole
            numbers: how many of the episodes of a period belong to each.
        options: the parts' keys: traffic.options.gan.noise_scale=0.5.
    """

    option = "mixed"
    _target_: ImportPath = "ganlane.traffic.MixedTraffic"
    shares: Annotated[dict[str, Annotated[int, at_least(1)]], _SHARES] = field(
        default_factory=lambda: {"idm_mobil": 1, "gan": 1}
    )
    options: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        # A mistyped name of a part would otherwise change nothing, and nobody would see it.
        for name in self.options:
            if name not in self.shares:
                raise ParameterError(
                    f"{{options.{name}}}: it has no share; give {{shares}} with {name}:1 in it."
                )
        # Only kinds known here can be refused; a model of your own may be anything.
        for name, part in self.parts().items():
            if isinstance(part, MixedTrafficConfig):
                raise ParameterError(f"{{shares}}={name}: it is a mixture itself; leave it out.")
            if isinstance(part, ReplayTrafficConfig):
                raise ParameterError(
                    f"{{shares}}={name}: it plays recordings on roads of its own; leave it out."
                )

    def parts(self) -> dict[str, TrafficConfig]:
        """The traffics of the mixture, by name."""
        return {
            # By name, so that the part's YAML file applies below the options.
            name: make(TrafficConfig, {"name": name, **self.options.get(name, {})}, "shares")
            for name in self.shares
        }

    def arguments(self) -> dict[str, Any]:
        """The shares; the parts are made by who makes the traffic."""
        return {"shares": dict(self.shares)}


@dataclass(frozen=True)
class ReplayTrafficConfig(TrafficConfig):
    """``traffic=replay``: recorded traffic (:class:`ganlane.traffic.ReplayTraffic`).

    Attributes:
        path: scene CSV, or Parquet from ganlane prepare; null: US-101 in GANLANE_DATA or
            ../shared/data.
        least_s: the vehicle that the ego replaces is recorded at least so long from the start on,
            s.
        roads: JSON file that says where the lanes of the scenes begin and end
            (:func:`ganlane.sim.scene_files.read_roads`); null: all go on for ever.
    """

    option = "replay"
    _target_: ImportPath = "ganlane.traffic.ReplayTraffic"
    path: str | None = None
    least_s: Steps = 4.0
    roads: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.blind_share:
            raise ParameterError(
                f"{{blind_share}}={self.blind_share:g} with replayed traffic: recorded vehicles "
                "see no ego anyway; leave it out."
            )


@dataclass(frozen=True)
class SumoTrafficConfig(TrafficConfig):
    """``traffic=sumo``: SUMO's drivers (:class:`ganlane_simulators.SumoTraffic`).

    Attributes:
        truck_share: lorries among the others, 0 to 1, where the first scene has none of its own.
        truck_length_m: length of a lorry, m.
        lane_change_s: how long a lane change takes, s; below 1 it would look like a jump.
        keep_right: LC2013's lcKeepRight; 0: no change to the right for its own sake.
        speed_wander: how far a driver's desired speed strays from its mean, as a share of it.
    """

    option = "sumo"
    _target_: ImportPath = "ganlane_simulators.SumoTraffic"
    truck_share: Share = 0.15
    truck_length_m: Annotated[float, between(4.5, 25)] = 12.0
    lane_change_s: Annotated[float, at_least(1)] = 4.0
    keep_right: NotNegative = 1.0
    speed_wander: Annotated[float, between(0, 0.2)] = 0.03


@dataclass(frozen=True)
class HighwayEnvTrafficConfig(TrafficConfig):
    """``traffic=highway_env``: HighwayEnv's own (:class:`ganlane_simulators.HighwayEnvTraffic`)."""

    option = "highway_env"
    _target_: ImportPath = "ganlane_simulators.HighwayEnvTraffic"


def traffics_of(data: Any, key: str) -> dict[str, TrafficConfig]:
    """Traffics by name: of a list of options, which keep their names, or of a mapping.

    Raises:
        ParameterError: one is not known or named twice; ``key`` is the field that lists them.
    """
    if isinstance(data, Mapping) and data:
        return {str(name): make(TrafficConfig, value, key) for name, value in data.items()}
    # One name stands for a list of one, as everywhere on the command line.
    try:
        entries = [data] if isinstance(data, str) else list(data)
    except TypeError:  # a number, a class or a record
        entries = [data]
    traffics = [make(TrafficConfig, entry, key) for entry in entries]
    by_label = {traffic.label(): traffic for traffic in traffics}
    # Two of one name would share a row of every table.
    if not traffics or len(by_label) < len(traffics):
        raise ParameterError(
            f"{{{key}}}: expected a list of different traffics, not empty; to drive one twice give "
            f"names of your own, {{{key}}}={{mine: gan, other: {{name: gan, noise_scale: 0.5}}}}."
        )
    return by_label
