"""Who the kernel can drive: rule-driven drivers, and those of the shipped generated traffics.

Imports no torch. The weights of a generator are packed as network.hpp reads them.
"""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping
from ctypes import c_float, c_int32, c_void_p
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple

import numpy as np

from ganlane import keys
from ganlane.errors import UserError
from ganlane.native.library import BLOCK, ROWS_PER_THREAD, Loaded, find
from ganlane.native.settings import (
    Floats,
    Highway,
    MemoryArrays,
    Range,
    Settings,
    Structure,
    actions_of,
    ends_of,
    fields,
    filled,
    flow_of,
    range_of,
)
from ganlane.settings.driving import (
    DriverFaults,
    EgoParameters,
    HumanVariation,
    IdmParameters,
    MobilParameters,
    RandomDrivers,
    SteeringParameters,
    Visibility,
)
from ganlane.settings.episode import EpisodeParameters
from ganlane.settings.generated import (
    ANCHOR,
    QUANTILE_LEVELS,
    AnchorParameters,
    CalibratedChanges,
    GuardParameters,
    LiteralChanges,
    SuddenAccelerations,
)
from ganlane.settings.generator import (
    ACROSS_TOKENS,
    ALONG_TOKENS,
    FEATURES,
    GENERATOR,
    HUMAN_MEMORY,
    SIDE_FEATURES,
    GeneratorSizes,
    HumanSizes,
    human_sizes,
    misfit,
    shipped_generator,
    stored_sizes,
)
from ganlane.settings.observation import MaskParameters
from ganlane.settings.record import part_of
from ganlane.settings.traffic import (
    GanCalibratedTrafficConfig,
    GanTrafficConfig,
    HumanTrafficConfig,
    IdmFaultsTrafficConfig,
    IdmMobilTrafficConfig,
    IdmRandomTrafficConfig,
    IdmTrafficConfig,
    MixedTrafficConfig,
    TrafficConfig,
    interleaved,
)
from ganlane.weights import load_arrays

if TYPE_CHECKING:
    from ganlane.data.statistics import DrivingStatistics

Weights = Mapping[str, Floats]
#: Parameters of a random driver in its memory.
_TRAITS: Final = 11
#: The longest delay of a reaction, in steps: MOST_FIELDS of rows.hpp less 12 other numbers.
_MOST_STEPS: Final = 36
#: Layers of the kernel have a multiple of this many outputs.
_WIDEST: Final = 16
#: Correlation time of a driver's latent vector in the paper's traffic, s.
PAPER_NOISE_PERIOD_S = 5.0
#: Anchor of the calibrated traffic: the fitted one, with brisker acceleration and lane changes as
#: fast as recorded ones.
SIMULATED_ANCHOR: AnchorParameters = replace(
    ANCHOR,
    idm=replace(ANCHOR.idm, max_acceleration=1.0),
    lane_stiffness=0.6,
    lane_damping=1.55,
)
#: Wishes per executed lane change, measured in the simulation with 9 vehicles: a wish comes only
#: while the driver is near its lane's centre, and waiting for a gap costs distance. A slow test
#: holds the resulting rate.
WISH_PER_CHANGE = 1.8
#: An array of a memory: its type, and its shape behind [rows, vehicles].
_Array = tuple[str, tuple[int, ...]]
_NUMBER: Final[_Array] = ("float32", ())
_COUNT: Final[_Array] = ("int64", ())


def _numbers(count: int) -> _Array:
    """``count`` numbers of every vehicle."""
    return ("float32", (count,))


def _memory(fields: Mapping[str, _Array]) -> MemoryArrays:
    """The arrays of a memory by their keys in the state; names have dots for groups."""
    return {(keys.TRAFFIC, *name.split(".")): array for name, array in fields.items()}


@dataclass(frozen=True)
class RuleDrivers:
    """Rule-driven drivers.

    ``mobil=None``: they keep their lanes. With ``faults`` they make mistakes; with ``random``
    ranges no two are alike.
    """

    idm: IdmParameters = IdmParameters()
    steering: SteeringParameters = SteeringParameters()
    mobil: MobilParameters | None = None
    faults: DriverFaults | None = None
    random: RandomDrivers | None = None
    stream: int = 0
    blind_share: float = 0.0
    #: When others see a lane change.
    visibility: Visibility = Visibility.SIGNALLED

    @property
    def courteous(self) -> bool:
        """Whether they make room for those who have to leave a lane that ends."""
        return self.mobil is not None

    def memory(self) -> MemoryArrays:
        """Their memory in the order of faults.hpp or random_drivers.hpp, after the steering."""
        if self.faults is not None:
            return _memory(
                {
                    "base.steering": _NUMBER,
                    "late_reaction.past": _numbers(_steps(self.faults.late_reaction.delay_s)),
                    "late_reaction.left": _COUNT,
                    "phantom_braking.left": _COUNT,
                    "hesitant_change.hesitant": ("bool", ()),
                    "aborted_change.origin": _COUNT,
                }
            )
        arrays = {"steering": _NUMBER}
        if self.random is not None:
            arrays["traits"] = _numbers(_TRAITS)
            # The accelerations decided last, as many as the longest reaction takes steps.
            longest_steps = _steps(self.random.reaction_s[1])
            if longest_steps:
                arrays["past"] = _numbers(longest_steps)
        return _memory(arrays)

    def structures(self) -> dict[str, Structure]:
        """Further structures, by their names in :class:`~ganlane.native.settings.Settings`."""
        if self.faults is not None:
            return {"faults": _faults_of(self.faults)}
        if self.random is None:
            return {}

        ranges = {name: range_of(bounds) for name, bounds in vars(self.random).items()}
        longest_steps = _steps(self.random.reaction_s[1])
        return {"random": _Random(**ranges, delay_steps=longest_steps)}


@dataclass(frozen=True)
class NetworkDrivers:
    """Drivers by a network.

    Attributes:
        idm: the ego's; also of a guard's bounds and of a gap check.
        sizes, weights: of the network, by the names of its ``state_dict``.
        stream: family of episodes that the random numbers belong to.
        blind_share: of the episodes: nobody sees the ego.
    """

    idm: IdmParameters
    sizes: Any
    weights: Weights = field(repr=False)
    stream: int
    blind_share: float = field(default=0.0, kw_only=True)

    #: Of the ego: the others do not steer.
    steering: ClassVar[SteeringParameters] = SteeringParameters()
    #: When others see a lane change.
    visibility: ClassVar[Visibility] = Visibility.BODY


@dataclass(frozen=True)
class GeneratedDrivers(NetworkDrivers):
    """Drivers by a generator: ``gan``, or with an ``anchor`` ``gan_calibrated``.

    Attributes:
        noise_scale, noise_period_s: of the latent vectors.
        sudden, changes, guard: of the paper's; without a guard vehicles leave the road.
        anchor, checked_changes, headways_s: of the calibrated ones; headways are the 5, 25, 50, 75
            and 95 % quantiles.
    """

    sizes: GeneratorSizes
    noise_scale: float
    noise_period_s: float
    sudden: SuddenAccelerations = SuddenAccelerations()
    changes: LiteralChanges = LiteralChanges()
    guard: GuardParameters | None = None
    anchor: AnchorParameters | None = None
    checked_changes: CalibratedChanges = CalibratedChanges()
    headways_s: tuple[float, ...] = (0.0,) * len(QUANTILE_LEVELS)

    @property
    def mobil(self) -> MobilParameters:
        """The limits of a lane change, as MOBIL has them."""
        return self.checked_changes.limits()

    @property
    def courteous(self) -> bool:
        """As of :class:`RuleDrivers`; the paper's drivers heed nobody."""
        return self.anchor is not None

    def memory(self) -> MemoryArrays:
        """Their memory in the order of generated.hpp."""
        sizes = self.sizes
        if self.anchor is None:
            arrays = {
                "acceleration.acceleration": _NUMBER,
                "acceleration.left": _COUNT,
                "lane_change.clock": _COUNT,
                "lane_change.lateral_speed": _NUMBER,
            }
        else:
            arrays = {
                "generator.residual_mean": _numbers(2),
                "generator.headway": _NUMBER,
                "lane_change.wish": _COUNT,
                "lane_change.waited": _COUNT,
            }

        arrays["generator.displacement"] = _numbers(2)
        arrays["generator.noise"] = _numbers(sizes.noise)
        # The last motions, oldest first, each as its part of the LSTM's four gates.
        for index in range(sizes.observed - 1):
            arrays[f"generator.motion_{index}"] = _numbers(4 * sizes.hidden)
        return _memory(arrays)

    def structures(self) -> dict[str, Structure]:
        """As of :class:`RuleDrivers`."""
        return {"generated": _generated_of(self)}


@dataclass(frozen=True)
class HumanDrivers(NetworkDrivers):
    """Drivers by a policy of ``human``.

    Attributes:
        variation: how they differ from the fitted ones.
    """

    sizes: HumanSizes
    variation: HumanVariation
    #: Their lane changes are their own.
    mobil: ClassVar[None] = None
    courteous: ClassVar[bool] = True

    def memory(self) -> MemoryArrays:
        """Their memory in the order of human.hpp."""
        counts = {
            **dict(HUMAN_MEMORY),
            "acceleration": 1,
            "lateral_from": 1,
            "lateral_to": 1,
        }
        arrays = {}
        for name, count in counts.items():
            arrays[name] = _NUMBER if count == 1 else _numbers(count)
        return _memory(arrays)

    def structures(self) -> dict[str, Structure]:
        """As of :class:`RuleDrivers`."""
        numbers = {
            **vars(self.sizes),
            **vars(self.variation),
            "weights": _packed(_human_layers(self.sizes), self.weights),
        }
        return {"human": filled(Human, numbers)}


#: Drivers of one kind.
OneKind = RuleDrivers | GeneratedDrivers | HumanDrivers


@dataclass(frozen=True)
class MixedDrivers:
    """Drivers that differ from episode to episode, all with one model of the ego.

    ``parts`` by name; episode ``e`` belongs to the part number ``turns[e % len(turns)]``.
    """

    parts: dict[str, OneKind]
    turns: tuple[int, ...]

    @property
    def idm(self) -> IdmParameters:
        """The ego's."""
        return next(iter(self.parts.values())).idm

    @property
    def steering(self) -> SteeringParameters:
        """The ego's."""
        return next(iter(self.parts.values())).steering

    def memory(self) -> MemoryArrays:
        """That of all parts."""
        memory: MemoryArrays = {}
        for part in parts_of(self):
            memory |= part.memory
        return memory


Drivers = OneKind | MixedDrivers


class Part(NamedTuple):
    """Drivers of some episodes, and their memory in the state."""

    drivers: OneKind
    memory: MemoryArrays


def parts_of(drivers: Drivers) -> list[Part]:
    """The parts of mixed drivers; others are one part."""
    if not isinstance(drivers, MixedDrivers):
        return [Part(drivers, drivers.memory())]

    parts = []
    for name, part in drivers.parts.items():
        # The memory of a part is below its name.
        memory: MemoryArrays = {}
        for key, kind in part.memory().items():
            memory[(keys.TRAFFIC, name, *key[1:])] = kind
        parts.append(Part(part, memory))
    return parts


def rows_per_thread(drivers: OneKind) -> int:
    """Rows from which on a further thread pays."""
    return BLOCK if isinstance(drivers, NetworkDrivers) else ROWS_PER_THREAD


def turns_of(drivers: Drivers) -> tuple[int, ...]:
    """The part of successive episodes; of one part, 0."""
    return drivers.turns if isinstance(drivers, MixedDrivers) else (0,)


def by_network(drivers: Drivers) -> bool:
    """Whether a network moves some of them."""
    return any(isinstance(part.drivers, NetworkDrivers) for part in parts_of(drivers))


def mixed_drivers(parts: Mapping[str, Drivers | None], shares: Mapping[str, int]) -> Drivers | None:
    """Drivers in turns, by their ``shares``; None where the kernel cannot drive one of them.

    Args:
        parts: drivers by name; None: the kernel cannot drive as they do.
        shares: of the episodes, as whole numbers by the same names.
    """
    drivers: dict[str, OneKind] = {}
    for name, part in parts.items():
        if part is None or isinstance(part, MixedDrivers):
            return None
        drivers[name] = part

    names = list(drivers)
    turns = tuple(names.index(name) for name in interleaved(shares))
    mixed = MixedDrivers(drivers, turns)

    # The kernel has one ego for all rows.
    for part in drivers.values():
        if (part.idm, part.steering) != (mixed.idm, mixed.steering):
            return None
    return mixed


def blind(drivers: Drivers, share: float) -> Drivers | None:
    """These drivers, who do not see the ego in a ``share`` of the episodes; None where some of
    them are blind in others.
    """
    if isinstance(drivers, MixedDrivers):
        parts = {name: blind(part, share) for name, part in drivers.parts.items()}
        if None in parts.values():
            return None
        return replace(drivers, parts=parts)  # type: ignore[arg-type]

    if drivers.blind_share:
        return None
    return replace(drivers, blind_share=share)


def _steps(seconds: float) -> int:
    """Physics steps in so many seconds."""
    return round(seconds / keys.PHYSICS_STEP_S)


def decision_settings(
    highway: Highway,
    drivers: OneKind,
    episode: EpisodeParameters | None = None,
    ego: EgoParameters | None = None,
    ego_mobil: MobilParameters | None = None,
) -> Settings:
    """The numbers of a decision: of road, driving and episode.

    Args:
        highway: the road, and what the ego is commanded.
        drivers: the others, and how the ego follows and steers.
        episode, ego: None: their defaults.
        ego_mobil: how the ego falls behind before a change that it has to make; None: as the
            others.

    Raises:
        UserError: more lanes than the kernel has room for on a road with lanes that end.
    """
    episode = episode or EpisodeParameters()
    ego = ego or EgoParameters()
    idm = drivers.idm
    steering = drivers.steering
    mobil = drivers.mobil or MobilParameters()
    ego_mobil = ego_mobil or mobil

    # No two of these records have a field of one name.
    numbers: dict[str, Any] = {
        **vars(episode),
        **vars(ego),
        **vars(idm),
        **vars(steering),
        **vars(mobil),
        **highway._asdict(),
    }
    numbers |= {
        # The kernel multiplies where the model divides by a constant.
        "per_brake_scale": 1.0 / idm.brake_scale(),
        "per_near_s": 1.0 / steering.near_s,
        "per_far_s": 1.0 / steering.far_s,
        "per_lane_width": 1.0 / highway.lane_width_m,
        "substeps": episode.substeps(),
        # A number of steps, since sums of 0.1 s drift in floats.
        "timeout_steps": _steps(episode.timeout_s),
        # Of generated drivers only the limits of a lane change count.
        "mobil": isinstance(drivers, RuleDrivers) and drivers.mobil is not None,
        "courteous": drivers.courteous,
        "foresight": False,
        "stream": drivers.stream,
        "blind_share": drivers.blind_share,
        # How the ego falls behind.
        "courtesy": ego_mobil.courtesy,
        "safe_behind": ego_mobil.safe_deceleration,
        # Further structures, None (a null pointer) where the highway has nothing of the kind.
        "ends": ends_of(highway.stretches, ego_mobil),
        "actions": actions_of(highway.actions, episode.decision_period_s),
        "flow": flow_of(highway, episode.decision_period_s),
        "generated": None,
        "human": None,
        "faults": None,
        "random": None,
        **drivers.structures(),
    }
    return filled(Settings, numbers)


def mask_settings(
    highway: Highway, idm: IdmParameters, mask: MaskParameters, abort: bool
) -> Settings:
    """The numbers of the masks ``safe`` and ``foresight``."""
    # The mask reads few of the decision's numbers; the others are defaults.
    mobil = MobilParameters(safe_deceleration=mask.safe_deceleration)
    drivers = RuleDrivers(idm, mobil=mobil)
    ego = EgoParameters(abort_lane_change=abort)
    settings = decision_settings(highway, drivers, ego=ego)
    settings.foresight = mask.form == "foresight"
    return settings


class _Faults(Structure):
    """``Faults`` of faults.hpp."""

    _fields_ = (
        *fields(
            c_float,
            "braking_chance braking_steps deceleration lapse_chance lapse_steps"
            " hesitation_share pace abort_share abort_at",
        ),
        *fields(c_int32, "delay_steps"),
    )


def _faults_of(faults: DriverFaults) -> _Faults:
    """The numbers of the mistakes; durations become physics steps, rates chances in one."""
    braking = faults.phantom_braking
    late = faults.late_reaction
    return _Faults(
        braking_chance=chance_in_step(braking.per_hour),
        braking_steps=_steps(braking.lasts_s),
        deceleration=braking.deceleration,
        lapse_chance=chance_in_step(late.per_hour),
        lapse_steps=_steps(late.lasts_s),
        hesitation_share=faults.hesitant_change.share,
        pace=faults.hesitant_change.pace,
        abort_share=faults.aborted_change.share,
        abort_at=faults.aborted_change.at,
        delay_steps=_steps(late.delay_s),
    )


def chance_in_step(per_hour: float) -> float:
    """Of at least one event of a Poisson process within a step."""
    events_in_step = per_hour * keys.PHYSICS_STEP_S / 3600.0
    # 1 - exp(-events), without the rounding near 1.
    return -math.expm1(-events_in_step)


class _Random(Structure):
    """``Random`` of random_drivers.hpp."""

    _fields_ = (
        *fields(
            Range,
            "headway_s max_acceleration comfortable_deceleration strongest_braking politeness"
            " reaction_s sway_m sway_period_s desired_speed",
        ),
        *fields(c_int32, "delay_steps"),
    )


class Network(Structure):
    """``Network`` of network.hpp."""

    _fields_ = (
        *fields(c_void_p, "weights"),
        *fields(
            c_int32,
            "embedding hidden pooling pooled context noise neighbours extra_inputs motions"
            " differences",
        ),
    )


class Human(Structure):
    """``Human`` of human.hpp."""

    _fields_ = (
        *fields(c_void_p, "weights"),
        *fields(c_int32, "hidden lane_hidden"),
        *fields(c_float, "temperature lane_changes politeness"),
        *fields(c_int32, "delayed"),
    )


class Generated(Structure):
    """``Generated`` of generated.hpp."""

    _fields_ = (
        *fields(Network, "network"),
        *fields(c_float, "noise_share noise_fresh noise_scale"),
        *fields(c_int32, "calibrated guard"),
        *fields(
            c_float,
            "sudden_chance sudden_mean sudden_sd sudden_steps"
            " mean_steps lateral_speed_mps lateral_speed_sd_mps slowest_mps"
            " guard_headway_s slack hardest_braking centring damping edge_margin_m steepest_rad"
            " min_gap_m per_brake_scale min_acceleration max_acceleration"
            " lane_stiffness lane_damping residual_along residual_across washout_share"
            " changes_per_m patience_steps",
        ),
        ("headways_s", c_float * len(QUANTILE_LEVELS)),
        *fields(c_int32, "further_inputs"),
    )


def _generated_of(drivers: GeneratedDrivers) -> Generated:
    """The numbers of generated drivers; durations become physics steps, rates chances in one."""
    dt = keys.PHYSICS_STEP_S
    sizes = drivers.sizes
    sudden = drivers.sudden
    # Defaults where the kernel does not read them: it is told below whether there are any.
    guard = drivers.guard or GuardParameters()
    anchor = drivers.anchor or ANCHOR

    # As closed_loop.wander: what stays of a latent vector in a step.
    period_s = drivers.noise_period_s
    share = math.exp(-dt / period_s) if period_s > 0 else 0.0

    network = {
        **vars(sizes),
        "weights": _packed(_layers(sizes), drivers.weights),
        # A motion has its difference to the one before, so the first one observed is none.
        "motions": sizes.observed - 1,
    }
    numbers: dict[str, Any] = {
        **vars(drivers),
        **vars(drivers.changes),
        **vars(anchor),
        **vars(anchor.idm),
        **vars(guard),
        "network": filled(Network, network),
        "calibrated": drivers.anchor is not None,
        "guard": drivers.guard is not None,
        # Latent vectors: what stays in a step, and what is added so that their variance stays.
        "noise_share": share,
        "noise_fresh": math.sqrt(1.0 - share * share),
        # Of the paper's drivers.
        "sudden_chance": dt / sudden.every_s,
        "sudden_mean": sudden.mean,
        "sudden_sd": sudden.sd,
        "sudden_steps": _steps(sudden.lasts_s),
        "guard_headway_s": guard.headway_s,
        # The guard's pull within a step.
        "centring": guard.centring_per_s * dt,
        # Of the calibrated drivers.
        "per_brake_scale": 1.0 / anchor.idm.brake_scale(),
        "residual_along": anchor.residual[0],
        "residual_across": anchor.residual[1],
        "washout_share": dt / anchor.washout_s,
        "changes_per_m": dt * drivers.checked_changes.per_km / 1000.0,
        "patience_steps": _steps(drivers.checked_changes.patience_s),
    }
    return filled(Generated, numbers)


class _Layer(NamedTuple):
    """A layer of a network by its names in the ``state_dict``.

    ``bias``: None: it has none, or another layer adds it. ``outputs`` has those of all gates.
    ``gates``: those of an LSTM that the kernel computes; a layer without gates is one gate.
    """

    weight: str
    bias: str | None
    inputs: int
    outputs: int
    gates: tuple[int, ...] = (0,)


def _dense(name: str, inputs: int, outputs: int, gates: tuple[int, ...] = (0,)) -> _Layer:
    """A layer with a bias."""
    return _Layer(f"{name}.weight", f"{name}.bias", inputs, outputs, gates)


def _layers(s: GeneratorSizes) -> list[_Layer]:
    """All layers of a generator in the order of ``layers_of`` in network.hpp."""
    motion = 4
    state = s.hidden + s.pooled + s.extra_inputs

    # Input, forget, output, new. The decoder's cell begins at 0, so its forget gate is left out.
    gates = 4 * s.hidden
    every = (0, 1, 2, 3)
    three = (0, 2, 3)

    # The bias of a pair's first layer is added with the other vehicle's term.
    pair_bias = "pooling.per_pair.bias"

    return [
        _dense("encoder.embed", motion, s.embedding),
        _dense("encoder.input", s.embedding, gates, every),
        _Layer("encoder.recurrent", None, s.hidden, gates, every),
        _Layer("pooling.per_pair.weight", None, motion, s.pooling),
        _Layer("pooling.per_vehicle.weight", pair_bias, s.hidden, s.pooling),
        _dense("pooling.second", s.pooling, s.pooled),
        _dense("context.0", state, s.context),
        _dense("context.2", s.context, s.hidden - s.noise),
        _dense("decoder.embed", motion, s.embedding),
        _dense("decoder.input", s.embedding, gates, three),
        _Layer("decoder.recurrent", None, s.hidden, gates, three),
        _dense("head", s.hidden, 2),
    ]


def _human_layers(sizes: HumanSizes) -> list[_Layer]:
    """All layers of a policy of ``human`` in the order of human.hpp."""
    return [
        _dense("trunk.0", FEATURES, sizes.hidden),
        _dense("trunk.2", sizes.hidden, sizes.hidden),
        _dense("along", sizes.hidden, ALONG_TOKENS),
        _dense("across", sizes.hidden, ACROSS_TOKENS),
        _dense("lane.0", SIDE_FEATURES, sizes.lane_hidden),
        _dense("lane.2", sizes.lane_hidden, 2),
    ]


def _check_shapes(source: Path, sizes: Any, layers: list[_Layer], weights: Weights) -> None:
    """Raise :class:`UserError` unless the ``weights`` are those of the ``layers``."""
    shapes: dict[str, tuple[int, ...]] = {}
    for layer in layers:
        shapes[layer.weight] = (layer.outputs, layer.inputs)
        if layer.bias is not None:
            shapes[layer.bias] = (layer.outputs,)

    stored = {name: array.shape for name, array in weights.items()}
    if stored != shapes:
        raise misfit(source, vars(sizes))


def _packed(layers: list[_Layer], weights: Weights) -> Floats:
    """Of every layer the biases and the transposed weights, with zeros as further outputs; aligned
    to a vector.
    """
    numbers = np.concatenate([_filled_up(layer, weights) for layer in layers])

    # NumPy aligns to 16 bytes, a vector has up to 64: 16 numbers of 4 bytes. With room for so many
    # more, they begin at the first address in it that is a multiple of 64.
    room = np.empty(len(numbers) + _WIDEST, np.float32)
    start = -room.ctypes.data % 64 // 4
    aligned = room[start : start + len(numbers)]
    aligned[:] = numbers
    return aligned


def _filled_up(layer: _Layer, weights: Weights) -> Floats:
    """A layer as the kernel has it, [1 + inputs, outputs] in one dimension, biases first."""
    weight = weights[layer.weight]
    bias = np.zeros(len(weight)) if layer.bias is None else weights[layer.bias]
    columns = np.column_stack([bias, weight])

    # [gates, outputs of a gate, 1 + inputs], of which the kernel computes some.
    blocks = 1 if layer.gates == (0,) else 4
    gates = columns.reshape(blocks, len(weight) // blocks, -1)
    gates = gates[list(layer.gates)]

    # Every gate is filled up by itself, so that it begins with a vector.
    missing = -gates.shape[1] % _WIDEST
    padded = np.pad(gates, ((0, 0), (0, missing), (0, 0)))

    rows = padded.reshape(-1, gates.shape[2])
    return rows.T.astype(np.float32).ravel()


# From weights and their metadata


def gan_drivers(config: GanTrafficConfig, idm: IdmParameters, stream: int) -> GeneratedDrivers:
    """Drivers of ``traffic=gan``.

    Raises:
        UserError: the weights are missing, foreign or of the other preset, or their recordings hold
            no complete lane change.
    """
    source, weights, sizes, _, statistics = _fitted(config.path, "paper")
    return GeneratedDrivers(
        idm,
        sizes,
        weights,
        stream,
        config.noise_scale,
        PAPER_NOISE_PERIOD_S,
        sudden=sudden_accelerations(statistics),
        changes=literal_changes(statistics, source),
        guard=GuardParameters() if config.guard else None,
    )


def calibrated_drivers(
    config: GanCalibratedTrafficConfig, idm: IdmParameters, stream: int
) -> GeneratedDrivers:
    """Drivers of ``traffic=gan_calibrated``.

    Raises:
        UserError: the weights are missing, foreign, of the other preset, or fitted without
            per-driver parameters.
    """
    source, weights, sizes, metadata, statistics = _fitted(config.path, "calibrated")

    # Only None asks for the recorded rate; 0 is a rate.
    wishes_per_km = config.changes_per_km
    if wishes_per_km is None:
        # Without a recorded change nobody changes lanes.
        recorded_per_km = statistics.lane_changes.per_vehicle_km or 0.0
        wishes_per_km = WISH_PER_CHANGE * recorded_per_km

    return GeneratedDrivers(
        idm,
        sizes,
        weights,
        stream,
        config.noise_scale,
        config.noise_period_s,
        anchor=fitted_anchor(metadata, source),
        checked_changes=CalibratedChanges(wishes_per_km),
        headways_s=tuple(statistics.headway.quantile(level) for level in QUANTILE_LEVELS),
    )


def literal_changes(statistics: DrivingStatistics, source: object) -> LiteralChanges:
    """Equations 9 to 11 with the numbers of all recordings given to the fit, held-out ones too.

    Raises:
        UserError: ``source``, which is named in the message, has no complete lane change.
    """
    changes = statistics.lane_changes
    numbers = (
        changes.t_m_srlc_steps,
        changes.lateral_speed.mean,
        changes.lateral_speed.sd,
    )
    # A number is missing if no change was recorded from beginning to end.
    if None in numbers:
        raise UserError(
            f"{source}: its recordings hold no complete lane change, so equations 9 to 11 have no "
            "numbers; fit the generator to recordings with lane changes."
        )
    # The condition is for type checkers; no number is None here.
    return LiteralChanges(*(float(number) for number in numbers if number is not None))


def sudden_accelerations(statistics: DrivingStatistics) -> SuddenAccelerations:
    """Gaussian of the recorded accelerations over one second, of all scenes."""
    recorded = statistics.acceleration_smoothed
    default = SuddenAccelerations()
    return SuddenAccelerations(
        # Where no acceleration was recorded these are None; 0 is a number.
        mean=default.mean if recorded.mean is None else recorded.mean,
        sd=default.sd if recorded.sd is None else recorded.sd,
    )


def fitted_anchor(metadata: Mapping[str, Any], source: object) -> AnchorParameters:
    """:data:`SIMULATED_ANCHOR` with the washout and the further inputs of the fit (by default those
    of ``ANCHOR``).

    Args:
        metadata, source: of the weights (:func:`ganlane.generator.load_generator`), and their file
            for messages.

    Raises:
        UserError: impossible values.
    """
    # A file may lack these entries: then the defaults of the fit hold.
    stored = metadata.get("config")
    config = stored if isinstance(stored, Mapping) else {}
    washout_s = config.get("washout_s", ANCHOR.washout_s)
    further_inputs = config.get("further_inputs", ANCHOR.further_inputs)

    # `not washout_s > 0` since NaN has to fail; `type` since True is no number of seconds.
    if type(washout_s) not in (int, float) or not washout_s > 0 or type(further_inputs) is not bool:
        raise UserError(
            f"{source}: its config says washout_s={washout_s!r} and "
            f"further_inputs={further_inputs!r}, expected seconds above 0 and true or false; fit "
            "it again."
        )
    return replace(SIMULATED_ANCHOR, washout_s=float(washout_s), further_inputs=further_inputs)


def pays(drivers: Drivers) -> bool:
    """Whether the kernel is faster than the tensor code on this processor.

    Without an instruction for a product and a sum (x86 before 2013), a generator's network is a
    hundred times slower.
    """
    if not by_network(drivers) or platform.machine() not in ("x86_64", "AMD64"):
        return True
    library = find()
    return isinstance(library, Loaded) and library.variant != "default"


def faulty_drivers(drivers: RuleDrivers, faults: DriverFaults) -> RuleDrivers | None:
    """``drivers`` with ``faults``; None where they react later than the kernel can remember."""
    if _steps(faults.late_reaction.delay_s) > _MOST_STEPS:
        return None
    return replace(drivers, faults=faults)


def drivers_of(
    traffic: TrafficConfig, idm: IdmParameters, mobil: MobilParameters, stream: int
) -> Drivers | None:
    """The drivers of a traffic's settings; None where the kernel cannot drive as they do.

    The same as :meth:`ganlane.traffic.TrafficModule.native_drivers` says, known without torch.

    Raises:
        UserError: the weights are missing, foreign, of the other preset, or do not fit.
    """
    drivers: Drivers | None = None
    rules = RuleDrivers(idm, mobil=mobil, stream=stream)
    if isinstance(traffic, IdmTrafficConfig):
        drivers = replace(rules, mobil=None)
    elif isinstance(traffic, IdmMobilTrafficConfig):
        drivers = rules
    elif isinstance(traffic, IdmFaultsTrafficConfig):
        drivers = faulty_drivers(rules, part_of(traffic, DriverFaults))
    elif isinstance(traffic, IdmRandomTrafficConfig):
        drivers = replace(rules, random=part_of(traffic, RandomDrivers))
    elif isinstance(traffic, GanTrafficConfig):
        drivers = gan_drivers(traffic, idm, stream)
    elif isinstance(traffic, GanCalibratedTrafficConfig):
        drivers = calibrated_drivers(traffic, idm, stream)
    elif isinstance(traffic, HumanTrafficConfig):
        drivers = human_drivers(traffic, idm, stream)
    elif isinstance(traffic, MixedTrafficConfig):
        parts = traffic.parts()
        driven = {name: drivers_of(parts[name], idm, mobil, stream) for name in parts}
        drivers = mixed_drivers(driven, traffic.shares)

    if drivers is not None and traffic.blind_share:
        return blind(drivers, traffic.blind_share)
    return drivers


def _fitted(
    path: str | None, preset: Any
) -> tuple[Path, Weights, GeneratorSizes, Mapping[str, Any], DrivingStatistics]:
    """A generator's file, weights, sizes, metadata, and the statistics of its recordings.

    ``path`` None: the file that ships for the ``preset``.

    Raises:
        UserError: the weights are missing, foreign, of the other preset, or do not fit.
    """
    # Imports the readers of recordings, a third of a second that rule-driven traffic does without.
    from ganlane.data.statistics import DrivingStatistics

    source = Path(path or shipped_generator(preset))
    weights, metadata = load_arrays(source, GENERATOR)
    sizes = stored_sizes(source, metadata, preset)
    _check_shapes(source, sizes, _layers(sizes), weights)
    statistics = DrivingStatistics.from_dict(metadata["driving_statistics"])
    return source, weights, sizes, metadata, statistics


def human_drivers(config: HumanTrafficConfig, idm: IdmParameters, stream: int) -> HumanDrivers:
    """Drivers of ``traffic=human``.

    Raises:
        UserError: the weights are missing, foreign, or of other sizes.
    """
    source = Path(config.path or shipped_generator("human"))
    weights, metadata = load_arrays(source, GENERATOR)
    sizes = human_sizes(source, metadata)

    # The file also holds the networks of the fit.
    policy = {}
    for name, array in weights.items():
        if name.startswith("policy."):
            policy[name.removeprefix("policy.")] = array

    _check_shapes(source, sizes, _human_layers(sizes), policy)
    return HumanDrivers(idm, sizes, policy, stream, part_of(config, HumanVariation))
