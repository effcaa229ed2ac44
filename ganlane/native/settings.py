"""What the kernel works on: its arrays by the state's keys, and its settings as C structures.

Imports no torch. Every list of names here is in the order of the C structure that it mirrors: a
change in one is a change in both. The settings' fields are named as those of the parameters that
they come from.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Mapping
from ctypes import c_double, c_float, c_int32, c_int64, c_void_p
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from ganlane import keys
from ganlane.errors import UserError
from ganlane.settings.actions import CONTINUOUS, LANE, LANE_SPEED, ActionParameters
from ganlane.settings.driving import MobilParameters
from ganlane.settings.episode import SpawnParameters
from ganlane.settings.observation import (
    NEARNESS_M,
    OVERLAP_M,
    ROAD_SIGHT_M,
    ObservationScale,
)
from ganlane.settings.road import FAR_M, WALL, FlowParameters, Stretches, exit_lane, leaving

if TYPE_CHECKING:
    from ganlane.sim.scenes import FixedScene

#: A key of the state as the environment's TensorDict has it: ``"step"``, ``("vehicles", "x")``.
Key = str | tuple[str, ...]
Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]


def within(group: str, names: str | Iterable[str]) -> tuple[Key, ...]:
    """The keys of ``names`` in a group of the state."""
    if isinstance(names, str):
        names = names.split()
    return tuple((group, name) for name in names)


def _kinds(
    group: str, floats: Iterable[str], integers: Iterable[str], flags: Iterable[str]
) -> dict[Key, str]:
    """Types of the arrays of a group."""
    return {
        **dict.fromkeys(within(group, floats), "float32"),
        **dict.fromkeys(within(group, integers), "int64"),
        **dict.fromkeys(within(group, flags), "bool"),
    }


class Highway(NamedTuple):
    """A highway as the kernel is told of it.

    ``vehicles`` is M, ``stretches`` where the lanes begin and end, ``flow`` who enters and leaves
    (None: nobody), ``actions`` what the ego is commanded.
    """

    lanes: int = 3
    lane_width_m: float = 4.0
    vehicles: int = 9
    stretches: Stretches = ()
    flow: FlowParameters | None = None
    actions: ActionParameters = ActionParameters()


#: Stands for the steering angles of rule-driven drivers, wherever their memory has them.
STEERING: Final = (keys.TRAFFIC, "steering")
#: Of the drivers' memory, by key: type, and shape behind [rows, vehicles].
MemoryArrays = dict[Key, tuple[str, tuple[int, ...]]]
#: Arrays [rows, vehicles] and their types.
VEHICLE_ARRAYS: Final = _kinds(
    keys.VEHICLES, keys.VEHICLE_FLOATS, keys.VEHICLE_INTEGERS, keys.VEHICLE_FLAGS
)
#: The ends of an episode but that of a recorded scene, which the kernel does not drive.
END_EVENTS: Final = tuple(name for name in keys.END_EVENTS if name != "scene_end")
#: Arrays that the state has as [rows, 1]: of the events, and whether the episode has ended.
EVENT_ARRAYS: Final[dict[Key, str]] = {
    **dict.fromkeys(within(keys.EVENTS, END_EVENTS), "bool"),
    **dict.fromkeys(within(keys.EVENTS, keys.EVENT_COUNTS), "int64"),
    **dict.fromkeys(keys.DONE_FLAGS, "bool"),
}
#: The ego's memory [rows].
EGO_ARRAYS: Final = _kinds(keys.EGO, keys.EGO_FLOATS, keys.EGO_INTEGERS, keys.EGO_FLAGS)
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
    *within(keys.EGO, (*keys.EGO_INTEGERS, *keys.EVENT_COUNTS)),
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
    *within(keys.VEHICLES, "x y heading speed acceleration target_lane"),
    STEERING,
    *EGO_ARRAYS,
    keys.STEP,
    # The flags of the end are behind the set speed.
    *(name for name in EVENT_ARRAYS if name not in keys.DONE_FLAGS),
    SET_SPEED,
    *keys.DONE_FLAGS,
    VALID,
)

#: Fields of ``vehicles`` that no decision changes: the start of an episode sets them.
SCENE: Final = within(keys.VEHICLES, "length width desired_speed visibility valid")
#: What the mask reads of the vehicles, and the view of the ego and of whom it sees; in the order of
#: mask.cpp and observation.cpp.
MASKED: Final = "x y heading speed length width desired_speed target_lane visibility valid"
VIEWED_EGO: Final = "speed desired_speed length y"
VIEWED: Final = "x y speed valid"
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


def fields(kind: type, names: str) -> list[tuple[str, type]]:
    """Members of a structure of one type."""
    return [(name, kind) for name in names.split()]


class Layout:
    """The arrays of the state of a ``highway`` with drivers of this ``memory``.

    Attributes:
        kinds: type of every array that the kernel reads or writes, by key.
        inputs, outputs: of a decision, in the kernel's order. Those that are not in ``kinds`` are
            null pointers: generated drivers have no steering angles.
        written: the outputs that are in ``kinds``.
    """

    def __init__(self, memory: MemoryArrays, highway: Highway) -> None:
        self.kinds: dict[Key, str] = {**VEHICLE_ARRAYS, **EGO_ARRAYS, **EVENT_ARRAYS, **COUNTERS}
        if highway.actions.form == LANE_SPEED:
            self.kinds[SET_SPEED] = "float32"
        self.kinds |= {name: kind for name, (kind, _) in memory.items()}
        self._memory = memory

        # Rule-driven drivers' steering angles have their place among the others, whatever their key
        # in the memory; the rest of it follows in its own order.
        steering = next((name for name in memory if name[-1] == "steering"), STEERING)
        further = [name for name in memory if name != steering]

        self.inputs = [steering if name == STEERING else name for name in INPUTS] + further

        places: dict[Key, Key] = {STEERING: steering}
        if highway.flow is None:
            # The place of no array: a null pointer.
            places[VALID] = "valid"
        self.outputs = [places.get(name, name) for name in OUTPUTS] + further

        self.written = [name for name in self.outputs if name in self.kinds]

    def shape(self, name: Key, rows: int, vehicles: int) -> tuple[int, ...]:
        """Shape of an array of ``kinds`` for N ``rows`` of M ``vehicles``."""
        if name in self._memory:
            _, behind = self._memory[name]
            return (rows, vehicles, *behind)
        if name in VEHICLE_ARRAYS:
            return (rows, vehicles)
        return (rows,)


class Structure(ctypes.Structure):
    """A structure of the kernel."""

    #: By member what it was given. What a member points to has to live as long: ctypes holds the
    #: address alone.
    pointed: Mapping[str, Any] = {}


class Settings(Structure):
    """``Settings`` of model.hpp."""

    _fields_ = [
        *fields(
            c_float,
            "min_gap_m headway_s per_brake_scale min_acceleration max_acceleration"
            " threshold politeness_rear politeness_side safe_deceleration exclusive_m courtesy"
            " safe_behind"
            " per_near_s per_far_s gain_far gain_near gain_integral slow_mps max_angle_rad"
            " soft_crash_ttc_s soft_crash_gap_m goal_m lane_width_m per_lane_width",
        ),
        *fields(
            c_int32,
            "lanes vehicles substeps timeout_steps mobil courteous abort_lane_change foresight",
        ),
        *fields(c_int64, "stream"),
        *fields(c_double, "blind_share"),
        *fields(c_void_p, "generated human faults random ends actions flow"),
    ]


#: Lanes of a road whose lanes end; as in model.hpp.
_MOST_LANES: Final = 20


class Ends(Structure):
    """``Ends`` of model.hpp."""

    _fields_ = [
        *fields(c_float * _MOST_LANES, "begin end wall leave_by reach exit_by exit_reach"),  # type: ignore[arg-type]
        *fields(c_float, "mandatory_bias"),
        *fields(c_int32, "exit_lane"),
    ]


class Flow(Structure):
    """``Flow`` of model.hpp."""

    _fields_ = [
        ("arrival", c_double * _MOST_LANES),
        *fields(c_double, "exit_share"),
        *fields(c_float, "from_m to_m"),
    ]


class Actions(Structure):
    """``Actions`` of model.hpp."""

    _fields_ = [
        *fields(
            c_float,
            "speed_step_mps lowest_speed_mps strongest_acceleration strongest_braking"
            " decision_period_s",
        ),
        *fields(c_int32, "form"),
    ]


class View(Structure):
    """``View`` of observation.cpp."""

    _fields_ = [
        *fields(c_float, "range_m speed_mps lane_width_m nearness_m overlap_m sight_m heading_rad"),
        *fields(c_int32, "lanes vehicles drift overlap road control"),
        ("ends", c_void_p),
    ]

    def numbers(self) -> int:
        """Length of the observation: own state and lane change, lane view, road, commands."""
        # Lane view: ahead and behind in three lanes gap, nearness and relative speed, and with
        # drift the place in the lane.
        per_neighbour = 4 if self.drift else 3
        road = 8 if self.road else 0
        return 5 + 6 * per_neighbour + road + self.control


class Range(Structure):
    """``Range`` of arrays.hpp."""

    _fields_ = fields(c_float, "low span")


_FIXED_ARRAYS: Final = "x y speed length width desired_speed target_lane visibility"


class Fixed(Structure):
    """``Fixed`` of arrays.hpp."""

    _fields_ = [
        *fields(c_void_p, _FIXED_ARRAYS),
        *fields(c_float, "jitter_m jitter_mps"),
        *fields(c_int32, "waiting"),
    ]


class Spawn(Structure):
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


class Reward(Structure):
    """``Reward`` of step.cpp."""

    _fields_ = [
        *fields(
            c_float,
            "decision_period_s base_speed_mps low_acceleration"
            " lane_change out_of_road hard_crash soft_crash goal soft_crash_behind",
        ),
        *fields(c_int32, "literal_low_acceleration terms"),
    ]


Kind = TypeVar("Kind", bound=Structure)


def filled(kind: type[Kind], numbers: Mapping[str, Any]) -> Kind:
    """A structure with those of the ``numbers`` that it has.

    A member that is a pointer is given what it points to: a structure, an array, or None.

    Raises:
        KeyError: a member is missing in the ``numbers``.
    """
    members = {}
    for name, member, *_ in kind._fields_:
        # A missing number is a KeyError here instead of a 0 in the kernel.
        value = numbers[name]
        members[name] = _address(value) if member is c_void_p else value

    structure = kind(**members)
    structure.pointed = numbers
    return structure


def _address(target: ctypes.Structure | ctypes.Array[Any] | Array | None) -> int | None:
    """Where a structure or an array is; None: a null pointer."""
    if target is None:
        return None
    if isinstance(target, np.ndarray):
        return target.ctypes.data
    return ctypes.addressof(target)


def range_of(bounds: tuple[float, float]) -> Range:
    """A range as its lower end and its span, as the draw needs them."""
    low, high = bounds
    return Range(low, high - low)


def actions_of(actions: ActionParameters, decision_period_s: float) -> Actions | None:
    """What the ego is commanded; None: lanes alone."""
    if actions.form == LANE:
        return None
    numbers = {
        **vars(actions),
        "form": (LANE_SPEED, CONTINUOUS).index(actions.form),
        "decision_period_s": decision_period_s,
    }
    return filled(Actions, numbers)


def ends_of(
    stretches: Stretches,
    mobil: MobilParameters = MobilParameters(),  # noqa: B008 - frozen
) -> Ends | None:
    """Where lanes begin and end; None: all go on.

    Raises:
        UserError: more lanes than the kernel has room for.
    """
    if not stretches:
        return None
    if len(stretches) > _MOST_LANES:
        raise UserError(
            f"lanes={len(stretches)}: the native kernel has at most {_MOST_LANES} lanes on roads "
            "with lanes that end; set env.kernel=torch."
        )

    # By where each lane has to be left, and how many changes the goal is away: for those who stay
    # on the road, and for those who take the exit.
    goal = exit_lane(stretches)
    leave_by, changes = leaving(stretches)
    exit_by, exit_changes = leaving(stretches, goal)

    return Ends(
        begin=tuple(its.begin_m for its in stretches),
        end=tuple(its.end_m for its in stretches),
        wall=tuple(its.end_m if its.end == WALL else FAR_M for its in stretches),
        leave_by=leave_by,
        reach=tuple(mobil.mandatory_m * number for number in changes),
        exit_by=exit_by,
        exit_reach=tuple(mobil.mandatory_m * number for number in exit_changes),
        mandatory_bias=mobil.mandatory_bias,
        exit_lane=-1 if goal is None else goal,
    )


def flow_of(highway: Highway, period_s: float) -> Flow | None:
    """Who enters and leaves; None: nobody does."""
    flow = highway.flow
    if flow is None:
        return None
    # Chance of a vehicle in each lane within a decision.
    arrival = flow.arrivals(highway.stretches, period_s)
    return filled(Flow, {**vars(flow), "arrival": arrival})


def view_of(highway: Highway, scale: ObservationScale, form: str) -> View:
    """The numbers of an observation in :data:`NATIVE_FORMS`."""
    drift, overlap, road = NATIVE_FORMS[form]
    numbers = {
        **vars(scale),
        **highway._asdict(),
        "nearness_m": NEARNESS_M,
        "overlap_m": OVERLAP_M,
        "sight_m": ROAD_SIGHT_M,
        "heading_rad": HEADING_RAD,
        "drift": drift,
        "overlap": overlap,
        "road": road,
        "control": CONTROL_NUMBERS[highway.actions.form],
        "ends": ends_of(highway.stretches),
    }
    return filled(View, numbers)


def spawn_of(
    highway: Highway,
    spawn: SpawnParameters,
    stream: int,
    ego_visibility: int,
    others_visibility: int,
    recycle_share: float | None,
    scene: FixedScene | None = None,
) -> Spawn:
    """The numbers of the first scene of an episode.

    Args:
        highway: the road and the number of vehicles.
        spawn: Table II.
        stream: family of episodes that the random numbers belong to.
        ego_visibility, others_visibility: when others see a lane change of the ego, and of theirs.
        recycle_share: of the episodes put vehicles left behind ahead again; None: none does.
        scene: vehicles that stand in for those drawn from Table II.
    """
    numbers: dict[str, Any] = {}
    for name, value in vars(spawn).items():
        numbers[name] = range_of(value) if isinstance(value, tuple) else value
    numbers |= {
        **highway._asdict(),
        "stream": stream,
        "ego_visibility": ego_visibility,
        "others_visibility": others_visibility,
        "spacing_m": spawn.spacing_m,
        "capacity": spawn.lane_capacity(),
        "recycle": recycle_share is not None,
        "recycle_share": recycle_share or 0.0,
        "fixed": None if scene is None else _fixed_of(scene),
    }
    return filled(Spawn, numbers)


def _fixed_of(scene: FixedScene) -> Fixed:
    """The vehicles of a scene as arrays."""
    base = scene.base().as_dict()
    arrays = {}
    for name in _FIXED_ARRAYS.split():
        # The one scene [M]: its numbers in float64, rounded as the environment's float32 is.
        column = base[name].numpy()[0]
        kind = np.float32 if column.dtype == np.float64 else np.int64
        arrays[name] = np.ascontiguousarray(column.astype(kind))
    return filled(Fixed, vars(scene) | arrays)
