"""The kernel's settings as C structures, from the parameters of the environment. Imports no torch."""

from __future__ import annotations

import ctypes
from typing import Final

from ganlane.keys import PHYSICS_STEP_S
from ganlane.parameters.driving import EgoParameters, IdmParameters, MobilParameters, SteeringParameters
from ganlane.parameters.episode import EpisodeParameters, SpawnParameters
from ganlane.parameters.observation import NEARNESS_M, OVERLAP_M, ObservationScale, RewardParameters

#: The observations that the kernel computes: whether with drift, and with overlap.
NATIVE_FORMS: Final = {
    "lane_view": (False, False),
    "lane_view_drift": (True, False),
    "lane_view_overlap": (True, True),
}


class Settings(ctypes.Structure):
    """``Settings`` of model.hpp."""

    _fields_ = [
        *((name, ctypes.c_float) for name in (
            "min_gap", "headway", "per_brake_scale", "min_acceleration", "max_acceleration",
            "threshold", "politeness_rear", "politeness_side", "safe_deceleration", "exclusive",
            "per_near_s", "per_far_s", "gain_far", "gain_near", "gain_integral", "slow", "max_angle",
            "soft_crash_ttc", "soft_crash_gap", "goal", "lane_width", "per_lane_width",
        )),
        *((name, ctypes.c_int32) for name in (
            "lanes", "vehicles", "substeps", "timeout_steps", "mobil", "abort_lane_change",
        )),
    ]  # fmt: skip


class View(ctypes.Structure):
    """``View`` of observation.cpp."""

    _fields_ = (
        *((name, ctypes.c_float) for name in ("range", "speed_scale", "lane_width", "nearness_m", "overlap_m")),
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
            "front_speed", "rear_speed", "ego_speed", "desired_speed", "truck_desired_speed",
        )),
        *((name, ctypes.c_float) for name in (
            "spread", "spacing", "ego_desired_speed", "truck_share", "length", "width", "truck_length", "truck_width",
            "lane_width",
        )),
        *((name, ctypes.c_int32) for name in (
            "vehicles", "lanes", "capacity", "ego_visibility", "others_visibility", "recycle",
        )),
    ]  # fmt: skip


class Reward(ctypes.Structure):
    """``Reward`` of step.cpp."""

    _fields_ = (
        *((name, ctypes.c_float) for name in (
            "period", "base_speed", "low_acceleration",
            "lane_change", "out_of_road", "hard_crash", "soft_crash", "goal", "soft_crash_behind",
        )),
        *((name, ctypes.c_int32) for name in ("literal_low_acceleration", "terms")),
    )  # fmt: skip


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
    idm, steering, lane_changes = idm or IdmParameters(), steering or SteeringParameters(), mobil or MobilParameters()
    return Settings(
        min_gap=idm.min_gap_m,
        headway=idm.headway_s,
        per_brake_scale=1.0 / idm.brake_scale(),
        min_acceleration=idm.min_acceleration,
        max_acceleration=idm.max_acceleration,
        threshold=lane_changes.threshold,
        politeness_rear=lane_changes.politeness_rear,
        politeness_side=lane_changes.politeness_side,
        safe_deceleration=lane_changes.safe_deceleration,
        exclusive=lane_changes.exclusive_m,
        per_near_s=1.0 / steering.near_s,
        per_far_s=1.0 / steering.far_s,
        gain_far=steering.gain_far,
        gain_near=steering.gain_near,
        gain_integral=steering.gain_integral,
        slow=steering.slow_mps,
        max_angle=steering.max_angle_rad,
        soft_crash_ttc=ego.soft_crash_ttc_s,
        soft_crash_gap=ego.soft_crash_gap_m,
        goal=episode.goal_m,
        lane_width=lane_width_m,
        per_lane_width=1.0 / lane_width_m,
        lanes=lanes,
        vehicles=vehicles,
        substeps=episode.substeps(),
        timeout_steps=round(episode.timeout_s / PHYSICS_STEP_S),
        mobil=mobil is not None,
        abort_lane_change=ego.abort_lane_change,
    )


def safe_settings(
    lanes: int, lane_width_m: float, vehicles: int, idm: IdmParameters, safe_deceleration: float, abort: bool
) -> Settings:
    """The numbers of the mask ``safe``; ``safe_deceleration`` in m/s2."""
    settings = settings_of(lanes, lane_width_m, vehicles, ego=EgoParameters(abort_lane_change=abort), idm=idm)
    settings.safe_deceleration = safe_deceleration
    return settings


def view_of(lanes: int, lane_width_m: float, vehicles: int, scale: ObservationScale, form: str) -> View:
    """The numbers of an observation in :data:`NATIVE_FORMS`."""
    drift, overlap = NATIVE_FORMS[form]
    return View(
        scale.range_m, scale.speed_mps, lane_width_m, NEARNESS_M, OVERLAP_M, lanes, vehicles, drift, overlap
    )  # fmt: skip


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
    """The numbers of Table II; ``recycle_share`` of the episodes recycle their vehicles, None: no episode does."""

    def span(bounds: tuple[float, float]) -> Range:
        return Range(bounds[0], bounds[1] - bounds[0])

    return Spawn(
        recycle_share=recycle_share or 0.0,
        stream=stream,
        front_speed=span(spawn.front_speed_mps),
        rear_speed=span(spawn.rear_speed_mps),
        ego_speed=span(spawn.ego_speed_mps),
        desired_speed=span(spawn.desired_speed_mps),
        truck_desired_speed=span(spawn.truck_desired_speed_mps),
        spread=spawn.spread_m,
        spacing=spawn.spacing_m,
        ego_desired_speed=spawn.ego_desired_speed_mps,
        truck_share=spawn.truck_share,
        length=spawn.length_m,
        width=spawn.width_m,
        truck_length=spawn.truck_length_m,
        truck_width=spawn.truck_width_m,
        lane_width=lane_width_m,
        vehicles=vehicles,
        lanes=lanes,
        capacity=spawn.lane_capacity(),
        ego_visibility=ego_visibility,
        others_visibility=others_visibility,
        recycle=recycle_share is not None,
    )


def reward_of(reward: RewardParameters, decision_period_s: float) -> Reward:
    """The numbers of the reward, and of how many terms it is the sum."""
    return Reward(
        decision_period_s, reward.base_speed_mps, reward.low_acceleration,
        reward.lane_change, reward.out_of_road, reward.hard_crash, reward.soft_crash, reward.goal,
        reward.soft_crash_behind,
        reward.literal_low_acceleration, len(reward.term_names),
    )  # fmt: skip
