"""What the kernel works on: its arrays by the state's keys, and its settings as C structures.

Imports no torch. Every list of names here is in the order of the C structure that it mirrors: a
change in one is a change in both. The settings' fields are named as those of the parameters that
they come from.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from ctypes import c_double, c_float, c_int32, c_int64, c_void_p
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np
import numpy.typing as npt

from ganlane import keys
from ganlane.errors import UserError
from ganlane.settings.actions import CONTINUOUS, LANE, LANE_SPEED, ActionParameters
from ganlane.settings.driving import (
    MobilParameters,
)
from ganlane.settings.episode import EpisodeParameters, SpawnParameters
from ganlane.settings.observation import (
    NEARNESS_M,
    OVERLAP_M,
    ROAD_SIGHT_M,
    ObservationScale,
    RewardParameters,
)
from ganlane.settings.road import (
    FAR_M,
    WALL,
    FlowParameters,
    Stretches,
    exit_lane,
    leaving,
)

if TYPE_CHECKING:
    from ganlane.sim.scenes import FixedScene

#: A key of the state as the environment's TensorDict has it: ``"step"``, ``("vehicles", "x")``.
Key = str | tuple[str, ...]


def _within(group: str, *names: str) -> tuple[Key, ...]:
    return tuple((group, name) for name in names)


#: Stands for the steering angles of rule-driven drivers, wherever their memory has them.
STEERING: Final = (keys.TRAFFIC, "steering")
#: Of the drivers' memory, by key: type, and shape behind [rows, vehicles].
MemoryArrays = dict[Key, tuple[str, tuple[int, ...]]]
#: Arrays [rows, vehicles] and their types.
VEHICLE_ARRAYS: Final[dict[Key, str]] = {
    **dict.fromkeys(_within(keys.VEHICLES, *keys.VEHICLE_FLOATS), "float32"),
    **dict.fromkeys(_within(keys.VEHICLES, *keys.VEHICLE_INTEGERS), "int64"),
    **dict.fromkeys(_within(keys.VEHICLES, *keys.VEHICLE_FLAGS), "bool"),
}
#: Arrays that the state has as [rows, 1]: of the events, and whether the episode has ended.
EVENT_ARRAYS: Final[dict[Key, str]] = {
    # the end of a scene is one of recorded scenes, which the kernel does not drive
    **dict.fromkeys(
        _within(
            keys.EVENTS,
            "goal",
            "hard_crash",
            "out_of_road",
            "missed_exit",
            "timeout",
        ),
        "bool",
    ),
    **dict.fromkeys(_within(keys.EVENTS, *keys.EVENT_COUNTS), "int64"),
    **dict.fromkeys(keys.DONE_FLAGS, "bool"),
}
#: The ego's memory [rows].
EGO_ARRAYS: Final[dict[Key, str]] = {
    **dict.fromkeys(_within(keys.EGO, *keys.EGO_FLOATS), "float32"),
    **dict.fromkeys(_within(keys.EGO, *keys.EGO_INTEGERS), "int64"),
    **dict.fromkeys(_within(keys.EGO, *keys.EGO_FLAGS), "bool"),
}
#: Counters [rows].
COUNTERS: Final[dict[Key, str]] = dict.fromkeys((keys.SEED, keys.EPISODE, keys.STEP), "int64")
#: The speed that the ego aims at, where it is commanded.
SET_SPEED: Final = (keys.EGO, keys.SET_SPEED)
#: Who is on the road, which a decision changes where vehicles enter and leave.
VALID: Final = (keys.VEHICLES, "valid")
#: What goes into a decision, before the memory of generated drivers.
INPUTS: Final = (
    keys.ACTION,
    *VEHICLE_ARRAYS,
    STEERING,
    (keys.EGO, "steering"),
    *_within(keys.EGO, *keys.EGO_INTEGERS),
    *_within(keys.EGO, keys.SOFT_CRASH, keys.SOFT_CRASH_BEHIND),
    keys.STEP,
    "recycles",
    keys.SEED,
    keys.EPISODE,
    "controls",
    SET_SPEED,
    "rows",
)
#: What comes out of it, and out of the start of an episode.
OUTPUTS: Final = (
    *_within(
        keys.VEHICLES,
        "x",
        "y",
        "heading",
        "speed",
        "acceleration",
        "target_lane",
    ),
    STEERING,
    *EGO_ARRAYS,
    keys.STEP,
    *(name for name in EVENT_ARRAYS if name not in keys.DONE_FLAGS),
    SET_SPEED,
    *keys.DONE_FLAGS,
    VALID,
)
#: Fields of ``vehicles`` that no decision changes: the start of an episode sets them.
SCENE: Final = _within(
    keys.VEHICLES,
    "length",
    "width",
    "desired_speed",
    "visibility",
    "valid",
)
#: What the start of an episode reads, and what it writes besides the outputs of a decision.
STARTS: Final = (keys.SEED, keys.EPISODE, "fresh", *SCENE, "recycles")

#: The observations that the kernel computes: whether with drift, overlap, and the road ahead.
NATIVE_FORMS: Final = {
    "lane_view": (False, False, False),
    "lane_view_drift": (True, False, False),
    "lane_view_overlap": (True, True, False),
    "road_view": (True, True, True),
}
#: Numbers at the end of every observation that the driver needs to command more than the lane.
CONTROL_NUMBERS: Final = {LANE: 0, LANE_SPEED: 1, CONTINUOUS: 2}
#: Heading that counts as 1 there, rad: some 5 m/s to the side at 25 m/s.
HEADING_RAD: Final = 0.2
#: The action masks, in the order of step.cpp's numbers ``MASK_ROAD, MASK_LEGAL, MASK_SAFE``.
MASK_FORMS: Final = ("none", "legal", "safe")


def fields(kind: type, names: str) -> list[tuple[str, type]]:
    """Members of a structure of one type."""
    return [(name, kind) for name in names.split()]


class Layout:
    """The arrays of the state with drivers of this ``memory``; ``flow``: who enters and leaves.

    Attributes:
        kinds: type of every array that the kernel reads or writes, by key.
        inputs, outputs: of a decision, in the kernel's order. Those that are not in ``kinds`` are
            null pointers: generated drivers have no steering angles.
        written: the outputs that are in ``kinds``.
    """

    def __init__(
        self,
        memory: MemoryArrays,
        actions: ActionParameters | None = None,
        flow: FlowParameters | None = None,
    ) -> None:
        self.kinds: dict[Key, str] = {**VEHICLE_ARRAYS, **EGO_ARRAYS, **EVENT_ARRAYS, **COUNTERS}
        if actions is not None and actions.form == LANE_SPEED:
            self.kinds[SET_SPEED] = "float32"
        self.kinds |= {name: kind for name, (kind, _) in memory.items()}
        self._memory = memory
        # Rule-driven drivers' steering angles have their place among the others.
        steering = next((name for name in memory if name[-1] == "steering"), STEERING)
        further = [name for name in memory if name != steering]
        self.inputs: list[Key] = [steering if name == STEERING else name for name in INPUTS]
        self.outputs: list[Key] = [steering if name == STEERING else name for name in OUTPUTS]
        if flow is None:
            # The place of no array: a null pointer.
            self.outputs[self.outputs.index(VALID)] = "valid"
        self.inputs += further
        self.outputs += further
        self.written = [name for name in self.outputs if name in self.kinds]

    def shape(self, name: Key, rows: int, vehicles: int) -> tuple[int, ...]:
        """Shape of an array of ``kinds``."""
        if name in self._memory:
            return (rows, vehicles, *self._memory[name][1])
        return (rows, vehicles) if name in VEHICLE_ARRAYS else (rows,)


class Settings(ctypes.Structure):
    """``Settings`` of model.hpp."""

    _fields_ = [
        *fields(
            c_float,
            "min_gap_m headway_s per_brake_scale min_acceleration max_acceleration"
            " threshold politeness_rear politeness_side safe_deceleration exclusive_m courtesy"
            " per_near_s per_far_s gain_far gain_near gain_integral slow_mps max_angle_rad"
            " soft_crash_ttc_s soft_crash_gap_m goal_m lane_width_m per_lane_width",
        ),
        *fields(c_int32, "lanes vehicles substeps timeout_steps mobil abort_lane_change"),
        *fields(c_int64, "stream"),
        *fields(c_double, "blind_share"),
        *fields(c_void_p, "generated human faults random ends actions flow"),
    ]

    #: The structures that the last members point to, which have to live as long.
    pointed: list[Any]


#: Lanes of a road whose lanes end; as in model.hpp.
_MOST_LANES: Final = 20


class Ends(ctypes.Structure):
    """``Ends`` of model.hpp."""

    _fields_ = [
        *fields(c_float * _MOST_LANES, "begin end wall leave_by reach exit_by exit_reach"),  # type: ignore[arg-type]
        *fields(c_float, "mandatory_bias"),
        *fields(c_int32, "exit_lane"),
    ]


class Flow(ctypes.Structure):
    """``Flow`` of model.hpp."""

    _fields_ = [
        ("arrival", c_double * _MOST_LANES),
        *fields(c_double, "exit_share"),
        *fields(c_float, "from_m to_m"),
    ]


class Actions(ctypes.Structure):
    """``Actions`` of model.hpp."""

    _fields_ = [
        *fields(
            c_float,
            "speed_step_mps lowest_speed_mps strongest_acceleration strongest_braking"
            " decision_period_s",
        ),
        *fields(c_int32, "form"),
    ]


def actions_of(
    actions: ActionParameters | None, episode: EpisodeParameters | None
) -> dict[str, ctypes.Structure]:
    """What the ego is commanded, by the name in :class:`Settings`; empty for lanes alone."""
    if actions is None or actions.form == LANE:
        return {}
    form = (LANE_SPEED, CONTINUOUS).index(actions.form)
    period_s = (episode or EpisodeParameters()).decision_period_s
    numbers = vars(actions) | {"form": form, "decision_period_s": period_s}
    return {"actions": filled(Actions, numbers)}


class View(ctypes.Structure):
    """``View`` of observation.cpp."""

    _fields_ = [
        *fields(c_float, "range_m speed_mps lane_width_m nearness_m overlap_m sight_m heading_rad"),
        *fields(c_int32, "lanes vehicles drift overlap road control"),
        ("ends", c_void_p),
    ]

    #: The structure that ``ends`` points to, which has to live as long.
    pointed: Any

    def numbers(self) -> int:
        """Length of the observation: own state, lane view, own lane change, road, commands."""
        return 5 + 6 * (4 if self.drift else 3) + (8 if self.road else 0) + self.control


class Range(ctypes.Structure):
    """``Range`` of arrays.hpp."""

    _fields_ = fields(c_float, "low span")


_FIXED_ARRAYS: Final = "x y speed length width desired_speed target_lane visibility"


class Fixed(ctypes.Structure):
    """``Fixed`` of arrays.hpp."""

    _fields_ = [
        *fields(c_void_p, _FIXED_ARRAYS),
        *fields(c_float, "jitter_m jitter_mps"),
        *fields(c_int32, "waiting"),
    ]

    #: The arrays that its members point to, which have to live as long.
    arrays: list[npt.NDArray[Any]]


class Spawn(ctypes.Structure):
    """``Spawn`` of arrays.hpp."""

    _fields_ = [
        *fields(c_double, "recycle_share"),
        *fields(c_int64, "stream"),
        *fields(
            Range,
            "front_speed_mps rear_speed_mps ego_speed_mps desired_speed_mps"
            " truck_desired_speed_mps",
        ),
        *fields(
            c_float,
            "spread_m spacing_m ego_desired_speed_mps truck_share length_m width_m"
            " truck_length_m truck_width_m lane_width_m",
        ),
        *fields(c_int32, "vehicles lanes capacity ego_visibility others_visibility recycle"),
        ("fixed", c_void_p),
    ]

    #: The structure that ``fixed`` points to, which has to live as long.
    pointed: Any


class Reward(ctypes.Structure):
    """``Reward`` of step.cpp."""

    _fields_ = [
        *fields(
            c_float,
            "decision_period_s base_speed_mps low_acceleration"
            " lane_change out_of_road hard_crash soft_crash goal soft_crash_behind",
        ),
        *fields(c_int32, "literal_low_acceleration terms"),
    ]


Structure = TypeVar("Structure", bound=ctypes.Structure)


def filled(kind: type[Structure], numbers: Mapping[str, Any]) -> Structure:
    """A structure with those of the ``numbers`` that it has."""
    # A missing number is a KeyError here instead of a 0 in the kernel.
    return kind(**{member[0]: numbers[member[0]] for member in kind._fields_})


def ends_of(
    stretches: Stretches, mobil: MobilParameters | None = None
) -> dict[str, ctypes.Structure]:
    """Where lanes begin and end, by the name in :class:`Settings`; empty if all go on.

    Raises:
        UserError: more lanes than the kernel has room for.
    """
    if not stretches:
        return {}
    if len(stretches) > _MOST_LANES:
        raise UserError(
            f"lanes={len(stretches)}: the native kernel has at most {_MOST_LANES} lanes on roads "
            "with lanes that end; set env.kernel=torch."
        )
    mobil = mobil or MobilParameters()
    goal = exit_lane(stretches)
    leave_by, changes = leaving(stretches)
    exit_by, exit_changes = leaving(stretches, goal)
    numbers = {
        "begin": [stretch.begin_m for stretch in stretches],
        "end": [stretch.end_m for stretch in stretches],
        "wall": [its.end_m if its.end == WALL else FAR_M for its in stretches],
        "leave_by": leave_by,
        "reach": [mobil.mandatory_m * number for number in changes],
        "exit_by": exit_by,
        "exit_reach": [mobil.mandatory_m * number for number in exit_changes],
    }
    ends = Ends(mandatory_bias=mobil.mandatory_bias, exit_lane=-1 if goal is None else goal)
    for name, row in numbers.items():
        for lane, number in enumerate(row):
            getattr(ends, name)[lane] = number
    return {"ends": ends}


def flow_of(
    flow: FlowParameters | None,
    stretches: Stretches,
    period_s: float,
) -> dict[str, ctypes.Structure]:
    """Who enters and leaves, by the name in :class:`Settings`; empty if nobody does."""
    if flow is None:
        return {}
    structure = Flow(exit_share=flow.exit_share, from_m=flow.from_m, to_m=flow.to_m)
    for lane, probability in enumerate(flow.arrivals(stretches, period_s)):
        structure.arrival[lane] = probability
    return {"flow": structure}


def view_of(
    lanes: int,
    lane_width_m: float,
    vehicles: int,
    scale: ObservationScale,
    form: str,
    stretches: Stretches = (),
    actions: ActionParameters | None = None,
) -> View:
    """The numbers of an observation in :data:`NATIVE_FORMS`; ``actions``: those at whose numbers it
    ends.
    """
    ends = ends_of(stretches).get("ends")
    road = (lane_width_m, NEARNESS_M, OVERLAP_M, ROAD_SIGHT_M, HEADING_RAD, lanes, vehicles)
    # By position, in the order of the members of View.
    view = View(
        scale.range_m,
        scale.speed_mps,
        *road,
        *NATIVE_FORMS[form],
        CONTROL_NUMBERS[actions.form if actions is not None else LANE],
        None if ends is None else ctypes.addressof(ends),
    )
    view.pointed = ends
    return view


def spawn_of(
    lanes: int,
    lane_width_m: float,
    vehicles: int,
    spawn: SpawnParameters,
    stream: int,
    ego_visibility: int,
    others_visibility: int,
    recycle_share: float | None,
    scene: FixedScene | None = None,
) -> Spawn:
    """The numbers of Table II, or of a ``scene``; ``recycle_share`` of the episodes recycle, None:
    none does.
    """
    fixed = None if scene is None else _fixed_of(scene)
    numbers = vars(spawn) | {
        "lanes": lanes,
        "lane_width_m": lane_width_m,
        "vehicles": vehicles,
        "stream": stream,
        "ego_visibility": ego_visibility,
        "others_visibility": others_visibility,
        "spacing_m": spawn.spacing_m,
        "capacity": spawn.lane_capacity(),
        "recycle": recycle_share is not None,
        "recycle_share": recycle_share or 0.0,
        "fixed": None if fixed is None else ctypes.addressof(fixed),
    }
    # Ranges as their lower end and their span, as the draw needs them.
    for name, value in numbers.items():
        if isinstance(value, tuple | list):
            numbers[name] = Range(value[0], value[1] - value[0])
    structure = filled(Spawn, numbers)
    structure.pointed = fixed
    return structure


def _fixed_of(scene: FixedScene) -> Fixed:
    """The vehicles of a scene as arrays."""
    # Its numbers in float64, rounded as the environment's float32 is.
    base = {name: value.numpy()[0] for name, value in scene.base().as_dict().items()}
    arrays = {}
    for name in _FIXED_ARRAYS.split():
        numbers = base[name]
        kind = np.float32 if numbers.dtype == np.float64 else np.int64
        arrays[name] = np.ascontiguousarray(numbers.astype(kind))
    pointers = {name: array.ctypes.data for name, array in arrays.items()}
    jitter = {"jitter_m": scene.jitter_m, "jitter_mps": scene.jitter_mps}
    fixed = Fixed(**pointers, **jitter, waiting=scene.waiting)
    fixed.arrays = list(arrays.values())
    return fixed


def reward_of(reward: RewardParameters, decision_period_s: float) -> Reward:
    """The numbers of the reward, and of how many terms it is the sum."""
    numbers = {"decision_period_s": decision_period_s, "terms": len(reward.term_names)}
    return filled(Reward, vars(reward) | numbers)
