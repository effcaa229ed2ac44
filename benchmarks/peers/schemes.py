"""Table V's driver under each simulator's way of integrating it: what is left when everything else is equal.

The three schemes agree on the new speed, ``v' = v + a dt``, and differ in how far a vehicle gets:

========================  =====================  ==========================================
``BALLISTIC``             ``(v + v') / 2 * dt``  ganlane; SUMO with ``--step-method.ballistic``
``EXPLICIT_EULER``        ``v dt``               HighwayEnv
``SEMI_IMPLICIT_EULER``   ``v' dt``              SUMO as it comes
========================  =====================  ==========================================
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np

from benchmarks.peers.scene import DESIRED_SPEED_MPS, Array, Scene, Trace
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.idm import TABLE_V
from ganlane.sim.neighbours import FREE_GAP_M


class Scheme(Enum):
    """Weight of the new speed in the distance of a step."""

    BALLISTIC = 0.5
    EXPLICIT_EULER = 0.0
    SEMI_IMPLICIT_EULER = 1.0


@dataclass(frozen=True)
class Law:
    """A reading of IDM.

    Args:
        offset_m: added to the gap and to the minimum gap alike. 0 takes gaps from bumper to bumper; the length of
            a vehicle takes them from centre to centre, as HighwayEnv does.
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


def acceleration(speed: Array, gap: Array, leader_speed: Array, law: Law = LAW) -> Array:
    """IDM acceleration in m/s2, in NumPy and apart from the package's tensor code; all [..., M]."""
    p = TABLE_V
    dynamic = speed * p.headway_s + speed * (speed - leader_speed) / BRAKE
    wanted = p.min_gap_m + law.offset_m + (np.maximum(dynamic, 0.0) if law.floored else dynamic)
    free = 1.0 - (np.maximum(speed, 0.0) / DESIRED_SPEED_MPS) ** 4
    interaction = (wanted / (gap + law.offset_m)) ** 2
    return np.clip(p.max_acceleration * (free - interaction), p.min_acceleration, p.max_acceleration)


def equilibrium_gap(speed_mps: float, law: Law = LAW) -> float:
    """Net gap in metres at which a platoon at ``speed_mps`` is at rest with itself under ``law``."""
    p = TABLE_V
    wanted = p.min_gap_m + law.offset_m + speed_mps * p.headway_s
    return wanted / math.sqrt(1.0 - (speed_mps / DESIRED_SPEED_MPS) ** 4) - law.offset_m


def ahead(trace: Trace, law: Law = LAW) -> tuple[Array, Array]:
    """Net gap ahead of each vehicle and the speed of whoever is there, [T, M]; the first one sees nobody."""
    first = np.full_like(trace.speed[:, :1], law.free_gap_m)
    return np.hstack((first, trace.gap)), np.hstack((trace.speed[:, :1], trace.speed[:, :-1]))


def integrate(scene: Scene, scheme: Scheme, law: Law = LAW, dt: float = PHYSICS_STEP_S) -> Trace:
    """Drive ``scene`` with ``law`` and ``scheme`` at steps of ``dt`` seconds."""
    leader = scene.leader_speeds(dt) if scene.leader else None
    speed, position = np.array(scene.speeds_mps), scene.positions_m()
    speeds, positions = [speed], [position]
    for step in range(scene.steps(dt)):
        gap, leader_speed = ahead(Trace(speed[None], position[None]), law)
        new = speed + acceleration(speed, gap[0], leader_speed[0], law) * dt
        new = new if law.reverses else np.maximum(new, 0.0)
        if leader is not None:
            new[0] = leader[step + 1]
        position = position + dt * ((1.0 - scheme.value) * speed + scheme.value * new)
        speed = new
        speeds.append(speed)
        positions.append(position)
    return Trace(np.stack(speeds), np.stack(positions))
