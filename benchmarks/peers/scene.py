"""What is driven (one lane, Table V's drivers, a leader with a prescribed speed), and plain
equations that drive it.

The three integration schemes agree on the new speed, ``v' = v + a dt``, and differ in the distance
of a step:

========================  =====================  ==========================================
``BALLISTIC``             ``(v + v') / 2 * dt``  ganlane; SUMO with ``--step-method.ballistic``
``EXPLICIT_EULER``        ``v dt``               HighwayEnv
``SEMI_IMPLICIT_EULER``   ``v' dt``              SUMO by default
========================  =====================  ==========================================
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.idm import TABLE_V
from ganlane.sim.neighbours import FREE_GAP_M

Array = NDArray[np.float64]

#: Length of every vehicle, m.
LENGTH_M = 4.5
#: Everybody's desired speed, m/s: the ego's of Table II.
DESIRED_SPEED_MPS = 25.0
#: Position of the foremost vehicle at the start, m: far enough from the start of the peers' roads.
START_M = 2_000.0
#: Length of the peers' roads, m: nobody reaches the end of one.
ROAD_M = 40_000.0


@dataclass(frozen=True)
class Scene:
    """One lane of vehicles, the foremost first.

    Args:
        name: how the tables call it.
        seconds: how long it is driven.
        speeds_mps: speed of each vehicle at the start.
        gaps_m: net gap (bumper to bumper) ahead of each vehicle but the foremost.
        leader: the foremost vehicle's speed as (time in s, speed in m/s), straight lines between
            them; empty where it drives freely, as everybody else does.
    """

    name: str
    seconds: float
    speeds_mps: tuple[float, ...]
    gaps_m: tuple[float, ...] = ()
    leader: tuple[tuple[float, float], ...] = ()

    def steps(self, dt: float = PHYSICS_STEP_S) -> int:
        """Number of physics steps of ``dt`` seconds."""
        return round(self.seconds / dt)

    def leader_speeds(self, dt: float = PHYSICS_STEP_S) -> Array | None:
        """The leader's speed at every step, m/s, [steps + 1]; None where it drives freely."""
        if not self.leader:
            return None
        times, speeds = zip(*self.leader)
        return np.interp(np.arange(self.steps(dt) + 1) * dt, times, speeds)

    def positions_m(self) -> Array:
        """Position of each vehicle's centre at the start, m, [M]."""
        return START_M - np.cumsum([0.0, *(gap + LENGTH_M for gap in self.gaps_m)])


@dataclass(frozen=True)
class Trace:
    """A driven scene: speed (m/s) and position of the centre (m), [steps + 1, M]."""

    speed: Array
    position: Array

    @property
    def gap(self) -> Array:
        """Net gap ahead of each vehicle but the foremost, m, [steps + 1, M - 1]."""
        return self.position[:, :-1] - self.position[:, 1:] - LENGTH_M


#: Gaps of eight followers that are nobody's equilibrium, m.
UNEVEN_M = (30.0, 60.0, 25.0, 50.0, 35.0, 70.0, 28.0, 45.0)


def platoon(
    name: str, seconds: float, speed_mps: float, leader: tuple[tuple[float, float], ...]
) -> Scene:
    """Eight cars at one speed and at uneven gaps behind a leader."""
    return Scene(name, seconds, (speed_mps,) * 9, UNEVEN_M, leader)


FREE_ROAD = Scene("free road", 120.0, (10.0,))
CONSTANT = platoon("constant leader", 120.0, 15.0, ((0.0, 15.0),))
#: Brakes at 2 m/s2 and speeds up at 0.5 m/s2.
SLOW_AND_GO = platoon(
    "slow and go", 150.0, 20.0, ((0, 20.0), (40, 20.0), (45, 10.0), (80, 10.0), (100, 20.0))
)
#: The same change of speed within one physics step.
STEP = platoon("step", 150.0, 20.0, ((0, 20.0), (40, 20.0), (40.1, 10.0), (80, 10.0), (80.1, 20.0)))
OBSTACLE = Scene("standing obstacle", 90.0, (0.0, 20.0), (300.0,), ((0.0, 0.0),))
SCENES = (FREE_ROAD, CONSTANT, SLOW_AND_GO, STEP, OBSTACLE)

#: Speeds at which platoons are left to settle, m/s.
SETTLED_MPS = (5.0, 10.0, 15.0)


def settling(speed_mps: float) -> Scene:
    """A platoon that is given 450 s to settle behind a leader at constant speed."""
    return platoon(f"settling at {speed_mps:g} m/s", 450.0, speed_mps, ((0.0, speed_mps),))


class Scheme(Enum):
    """Weight of the new speed in the distance of a step."""

    BALLISTIC = 0.5
    EXPLICIT_EULER = 0.0
    SEMI_IMPLICIT_EULER = 1.0


@dataclass(frozen=True)
class Law:
    """A reading of IDM.

    Args:
        offset_m: added to the gap and to the minimum gap alike. 0 takes gaps from bumper to bumper;
            the length of a vehicle takes them from centre to centre, as HighwayEnv does.
        floored: the dynamic part of the desired gap is never negative (ganlane, SUMO).
        reverses: the speed may fall below 0 (HighwayEnv).
        free_gap_m: the gap that stands for nobody ahead.
    """

    offset_m: float = 0.0
    floored: bool = True
    reverses: bool = False
    free_gap_m: float = FREE_GAP_M


#: ganlane's reading.
LAW = Law()


#: Twice the root of IDM's two accelerations, m/s2: what the closing speed is divided by.
BRAKE = 2.0 * math.sqrt(TABLE_V.max_acceleration * TABLE_V.comfortable_deceleration)


def acceleration(speed: Array, gap: Array, leader_speed: Array, law: Law) -> Array:
    """IDM acceleration in m/s2, in NumPy and apart from the package's tensor code; all [..., M]."""
    p = TABLE_V
    dynamic = speed * p.headway_s + speed * (speed - leader_speed) / BRAKE
    wanted = p.min_gap_m + law.offset_m + (np.maximum(dynamic, 0.0) if law.floored else dynamic)
    free = 1.0 - (np.maximum(speed, 0.0) / DESIRED_SPEED_MPS) ** 4
    interaction = (wanted / (gap + law.offset_m)) ** 2
    return np.clip(
        p.max_acceleration * (free - interaction), p.min_acceleration, p.max_acceleration
    )


def equilibrium_gap(speed_mps: float, law: Law = LAW) -> float:
    """Net gap, m, at which a platoon at ``speed_mps`` is at rest with itself under ``law``."""
    p = TABLE_V
    wanted = p.min_gap_m + law.offset_m + speed_mps * p.headway_s
    return wanted / math.sqrt(1.0 - (speed_mps / DESIRED_SPEED_MPS) ** 4) - law.offset_m


def ahead(trace: Trace, law: Law) -> tuple[Array, Array]:
    """Net gap ahead of each vehicle and the speed of whoever is there, [T, M].

    The first one sees nobody.
    """
    first = np.full_like(trace.speed[:, :1], law.free_gap_m)
    return np.hstack((first, trace.gap)), np.hstack((trace.speed[:, :1], trace.speed[:, :-1]))


def integrate(scene: Scene, scheme: Scheme, law: Law = LAW, dt: float = PHYSICS_STEP_S) -> Trace:
    """Drive ``scene`` with ``law`` and ``scheme`` at steps of ``dt`` seconds."""
    leader = scene.leader_speeds(dt)
    speeds, positions = [np.array(scene.speeds_mps)], [scene.positions_m()]
    for step in range(scene.steps(dt)):
        speed, position = speeds[-1], positions[-1]
        gap, leader_speed = ahead(Trace(speed[None], position[None]), law)
        new = speed + acceleration(speed, gap[0], leader_speed[0], law) * dt
        new = new if law.reverses else np.maximum(new, 0.0)
        if leader is not None:
            new[0] = leader[step + 1]
        speeds.append(new)
        positions.append(position + dt * ((1.0 - scheme.value) * speed + scheme.value * new))
    return Trace(np.stack(speeds), np.stack(positions))
