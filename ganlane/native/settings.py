"""What the kernel works on: its arrays by name, and its settings as C structures. Imports no torch.

The settings' fields are named as those of the parameters that they come from.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from typing import Any, Final, NamedTuple, TypeVar

from ganlane.keys import PHYSICS_STEP_S
from ganlane.parameters.driving import (
    EgoParameters,
    IdmParameters,
    MobilParameters,
    SteeringParameters,
)
from ganlane.parameters.episode import EpisodeParameters, SpawnParameters
from ganlane.parameters.observation import NEARNESS_M, OVERLAP_M, ObservationScale, RewardParameters

_FLOAT, _INTEGER, _FLAG = "float32", "int64", "bool"
#: Arrays [rows, vehicles] and their types.
VEHICLE_ARRAYS: Final = {
    **dict.fromkeys(
        ("x", "y", "heading", "speed", "acceleration", "length", "width", "desired_speed"), _FLOAT
    ),
    **dict.fromkeys(("target_lane", "visibility"), _INTEGER),
    "valid": _FLAG,
    "steering": _FLOAT,
}
#: Events and done flags, [rows].
EVENT_ARRAYS: Final = {
    **dict.fromkeys(("goal", "hard_crash", "out_of_road", "timeout"), _FLAG),
    **dict.fromkeys(("soft_crashes", "soft_crashes_behind"), _INTEGER),
    **dict.fromkeys(("done", "terminated", "truncated"), _FLAG),
}
#: The other arrays [rows].
ROW_ARRAYS: Final = {
    **dict.fromkeys(
        ("seed", "episode", "action", "change_direction", "decisions", "lane_changes", "step"),
        _INTEGER,
    ),
    **dict.fromkeys(
        ("ego_steering", "mean_acceleration", "change_progress", "distance", "reward"), _FLOAT
    ),
    **dict.fromkeys(
        ("soft_crash", "soft_crash_behind", "started_change", "recycles", "fresh"), _FLAG
    ),
}
# The structures of arrays.hpp, in their order.
_EGO = (
    "ego_steering",
    "change_direction",
    "decisions",
    "lane_changes",
    "soft_crash",
    "soft_crash_behind",
)
INPUTS: Final = ("action", *VEHICLE_ARRAYS, *_EGO, "step", "recycles")
OUTPUTS: Final = (
    "x", "y", "heading", "speed", "acceleration", "target_lane", "steering",
    "ego_steering", "mean_acceleration", "change_progress", "distance",
    "change_direction", "decisions", "lane_changes", "soft_crash", "soft_crash_behind", "started_change",
    "step", *EVENT_ARRAYS,
)  # fmt: skip
SCENE: Final = (
    "seed",
    "episode",
    "fresh",
    "length",
    "width",
    "desired_speed",
    "visibility",
    "valid",
    "recycles",
)

#: The observations that the kernel computes: whether with drift, and with overlap.
NATIVE_FORMS: Final = {
    "lane_view": (False, False),
    "lane_view_drift": (True, False),
    "lane_view_overlap": (True, True),
}


class RuleDrivers(NamedTuple):
    """Drivers that the kernel knows; ``mobil=None``: they keep their lanes."""

    idm: IdmParameters
    steering: SteeringParameters = SteeringParameters()
    mobil: MobilParameters | None = None


class Settings(ctypes.Structure):
    """``Settings`` of model.hpp."""

    _fields_ = [
        *((name, ctypes.c_float) for name in (
            "min_gap_m", "headway_s", "per_brake_scale", "min_acceleration", "max_acceleration",
            "threshold", "politeness_rear", "politeness_side", "safe_deceleration", "exclusive_m",
            "per_near_s", "per_far_s", "gain_far", "gain_near", "gain_integral", "slow_mps", "max_angle_rad",
            "soft_crash_ttc_s", "soft_crash_gap_m", "goal_m", "lane_width_m", "per_lane_width",
        )),
        *((name, ctypes.c_int32) for name in (
            "lanes", "vehicles", "substeps", "timeout_steps", "mobil", "abort_lane_change",
        )),
    ]  # fmt: skip


class View(ctypes.Structure):
    """``View`` of observation.cpp."""

    _fields_ = (
        *(
            (name, ctypes.c_float)
            for name in ("range_m", "speed_mps", "lane_width_m", "nearness_m", "overlap_m")
        ),
        *((name, ctypes.c_int32) for name in ("lanes", "vehicles", "drift", "overlap")),
    )

    def numbers(self) -> int:
        """Length of the observation: own state, lane view, own lane change."""
        return 5 + 6 * (4 if self.drift else 3)


class Range(ctypes.Structure):
    """``Range`` of arrays.hpp."""

    _fields_ = (("low", ctypes.c_float), ("span", ctypes.c_float))


class Spawn(ctypes.Structure):
    """``Spawn`` of arrays.hpp."""

    _fields_ = [
        ("recycle_share", ctypes.c_double),
        ("stream", ctypes.c_int64),
        *((name, Range) for name in (
            "front_speed_mps", "rear_speed_mps", "ego_speed_mps", "desired_speed_mps", "truck_desired_speed_mps",
        )),
        *((name, ctypes.c_float) for name in (
            "spread_m", "spacing_m", "ego_desired_speed_mps", "truck_share", "length_m", "width_m", "truck_length_m",
            "truck_width_m", "lane_width_m",
        )),
        *((name, ctypes.c_int32) for name in (
            "vehicles", "lanes", "capacity", "ego_visibility", "others_visibility", "recycle",
        )),
    ]  # fmt: skip


class Reward(ctypes.Structure):
    """``Reward`` of step.cpp."""

    _fields_ = (
        *((name, ctypes.c_float) for name in (
            "decision_period_s", "base_speed_mps", "low_acceleration",
            "lane_change", "out_of_road", "hard_crash", "soft_crash", "goal", "soft_crash_behind",
        )),
        *((name, ctypes.c_int32) for name in ("literal_low_acceleration", "terms")),
    )  # fmt: skip


Structure = TypeVar("Structure", bound=ctypes.Structure)


def _filled(kind: type[Structure], given: Mapping[str, Any]) -> Structure:
    """A structure with those of the ``given`` numbers that it has."""
    return kind(**{field[0]: given[field[0]] for field in kind._fields_})


def settings_of(
    lanes: int,
    lane_width_m: float,
    vehicles: int,
    episode: EpisodeParameters | None = None,
    ego: EgoParameters | None = None,
    idm: IdmParameters | None = None,
    steering: SteeringParameters | None = None,
    mobil: MobilParameters | None = None,
) -> Settings:
    """The numbers of road, driving and episode; ``mobil=None``: the others keep their lanes."""
    episode, ego = episode or EpisodeParameters(), ego or EgoParameters()
    idm, steering = idm or IdmParameters(), steering or SteeringParameters()
    given = {
        **(
            vars(episode)
            | vars(ego)
            | vars(idm)
            | vars(steering)
            | vars(mobil or MobilParameters())
        ),
        **{"lanes": lanes, "lane_width_m": lane_width_m, "vehicles": vehicles},
        "per_brake_scale": 1.0 / idm.brake_scale(),
        "per_near_s": 1.0 / steering.near_s,
        "per_far_s": 1.0 / steering.far_s,
        "per_lane_width": 1.0 / lane_width_m,
        "substeps": episode.substeps(),
        "timeout_steps": round(episode.timeout_s / PHYSICS_STEP_S),
        "mobil": mobil is not None,
    }
    return _filled(Settings, given)


def safe_settings(
    lanes: int,
    lane_width_m: float,
    vehicles: int,
    idm: IdmParameters,
    safe_deceleration: float,
    abort: bool,
) -> Settings:
    """The numbers of the mask ``safe``; ``safe_deceleration`` in m/s2."""
    settings = settings_of(
        lanes, lane_width_m, vehicles, ego=EgoParameters(abort_lane_change=abort), idm=idm
    )
    settings.safe_deceleration = safe_deceleration
    return settings


def view_of(
    lanes: int, lane_width_m: float, vehicles: int, scale: ObservationScale, form: str
) -> View:
    """The numbers of an observation in :data:`NATIVE_FORMS`."""
    road = (lane_width_m, NEARNESS_M, OVERLAP_M, lanes, vehicles)
    return View(scale.range_m, scale.speed_mps, *road, *NATIVE_FORMS[form])


def spawn_of(
    lanes: int,
    lane_width_m: float,
    vehicles: int,
    spawn: SpawnParameters,
    stream: int,
    ego_visibility: int,
    others_visibility: int,
    recycle_share: float | None,
) -> Spawn:
    """The numbers of Table II; ``recycle_share`` of the episodes recycle their vehicles, None.

    No episode does.
    """

    def of_struct(value: Any) -> Any:
        return value if isinstance(value, int | float) else Range(value[0], value[1] - value[0])

    given = {
        **{name: of_struct(value) for name, value in vars(spawn).items()},
        **{"lanes": lanes, "lane_width_m": lane_width_m, "vehicles": vehicles, "stream": stream},
        **{"ego_visibility": ego_visibility, "others_visibility": others_visibility},
        "spacing_m": spawn.spacing_m,
        "capacity": spawn.lane_capacity(),
        "recycle": recycle_share is not None,
        "recycle_share": recycle_share or 0.0,
    }
    return _filled(Spawn, given)


def reward_of(reward: RewardParameters, decision_period_s: float) -> Reward:
    """The numbers of the reward, and of how many terms it is the sum."""
    given = {
        **vars(reward),
        "decision_period_s": decision_period_s,
        "terms": len(reward.term_names),
    }
    return _filled(Reward, given)
