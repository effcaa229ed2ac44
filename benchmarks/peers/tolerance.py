"""By how much another way of integrating may change a trace, from the accelerations recorded in
ours.

All schemes give the same new speed; they differ in the distance of a step by
``(weight - 1/2) (v' - v) dt``. Summed over the steps this telescopes: at equal speeds a vehicle is
``(weight - 1/2) dt (v(t) - v(0))`` ahead of ours. The gaps are then other ones, IDM answers them,
and the answers run down the platoon. To first order in ``dt`` the difference ``(e_s, e_v)`` of gap
and speed follows from IDM's partial derivatives along our own trace:

    e_v' = e_v + dt (a_s e_s + a_v e_v + a_l e_leader)
    e_s' = e_s + dt/2 (e_leader + e_leader' - e_v - e_v') + (weight - 1/2) dt (change of v_leader -
    change of v)

No simulator but ours takes part in this, and the other scheme is never run.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from benchmarks.peers.scene import (
    BRAKE,
    DESIRED_SPEED_MPS,
    LAW,
    Array,
    Law,
    Scene,
    Scheme,
    Trace,
    acceleration,
    ahead,
)
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.idm import TABLE_V

#: Room for the terms of second order: products of two differences, each of them small beside gap
#: and speed.
MARGIN = 1.1


class Slopes(NamedTuple):
    """IDM's partial derivatives with respect to gap (1/s2), own speed and the leader's speed (1/s),
    [T, M].
    """

    gap: Array
    speed: Array
    leader: Array


def slopes(speed: Array, gap: Array, leader_speed: Array, law: Law) -> Slopes:
    """Derivatives of :func:`~benchmarks.peers.scene.acceleration`.

    0 where it is cut to Table V's bounds.
    """
    p = TABLE_V
    dynamic = speed * p.headway_s + speed * (speed - leader_speed) / BRAKE
    answers = (dynamic > 0.0) | (not law.floored)
    dynamic = np.where(answers, dynamic, 0.0)
    by_speed = np.where(answers, p.headway_s + (2.0 * speed - leader_speed) / BRAKE, 0.0)
    by_leader = np.where(answers, -speed / BRAKE, 0.0)
    ratio = (p.min_gap_m + law.offset_m + dynamic) / (gap + law.offset_m)
    pull = 2.0 * p.max_acceleration * ratio / (gap + law.offset_m)
    free = 4.0 * p.max_acceleration * np.maximum(speed, 0.0) ** 3 / DESIRED_SPEED_MPS**4
    uncut = acceleration(speed, gap, leader_speed, law) > p.min_acceleration
    return Slopes(
        uncut * pull * ratio, uncut * -(free + pull * by_speed), uncut * -pull * by_leader
    )


def difference(trace: Trace, scene: Scene, scheme: Scheme, law: Law = LAW) -> Trace:
    """First-order difference of speed and position between ``scheme`` and the ballistic ``trace``,
    [steps + 1, M].
    """
    by = slopes(trace.speed, *ahead(trace, law), law)
    dt = PHYSICS_STEP_S
    shift = (scheme.value - 0.5) * dt * np.diff(trace.speed, axis=0)
    speed, position = np.zeros_like(trace.speed), np.zeros_like(trace.speed)
    for k in range(len(shift)):
        e_v, e_x = speed[k], position[k]
        e_gap, e_leader = np.append(0.0, e_x[:-1] - e_x[1:]), np.append(0.0, e_v[:-1])
        new = e_v + dt * (by.gap[k] * e_gap + by.speed[k] * e_v + by.leader[k] * e_leader)
        # Whoever stands in our trace stands.
        new = np.where((trace.speed[k + 1] == 0.0) & (not law.reverses), 0.0, new)
        if scene.leader:
            new[0] = 0.0
        speed[k + 1] = new
        position[k + 1] = e_x + 0.5 * dt * (e_v + new) + shift[k]
    return Trace(speed, position)


class Largest(NamedTuple):
    """The largest absolute difference at any moment of any vehicle.

    Speed (m/s), gap and position (m).
    """

    speed_mps: float
    gap_m: float
    position_m: float


#: What double precision may leave after minutes at positions of kilometres. SUMO's
#: "nobody ahead" is a leader 1000 km away, worth ``v0/4 (v0 T / 10^6 m)^2`` = 1e-8 m/s, and is in
#: it too.
ROUNDING = Largest(speed_mps=2e-8, gap_m=2e-6, position_m=2e-6)


def between(one: Trace, other: Trace) -> Largest:
    """How far two traces of one scene are apart."""
    return Largest(
        largest(one.speed - other.speed),
        largest(one.gap - other.gap),
        largest(one.position - other.position),
    )


def tolerance(trace: Trace, scene: Scene, scheme: Scheme, law: Law = LAW) -> Largest:
    """How far ``scheme`` may be from the ballistic ``trace``.

    :func:`difference`, margin and rounding.
    """
    nothing = np.zeros_like(trace.speed)
    sizes = between(difference(trace, scene, scheme, law), Trace(nothing, nothing))
    return Largest(*(MARGIN * size + rest for size, rest in zip(sizes, ROUNDING)))


def largest(values: Array) -> float:
    """Largest absolute value; 0 of nothing."""
    return float(np.abs(values).max(initial=0.0))


def unsettled_gap_m(trace: Trace, law: Law) -> float:
    """How far the last gaps may still be from the equilibrium gap, from the motion that is left at
    the end, m.

    A gap ``e`` away from equilibrium asks for ``a_s e``; what else moves a driver then is its own
    and its leader's speed, at their slopes.
    """
    end = Trace(trace.speed[-2:], trace.position[-2:])
    left = np.abs(np.diff(end.speed, axis=0)[0, 1:]) / PHYSICS_STEP_S
    by_gap, by_speed, by_leader = np.abs(slopes(end.speed, *ahead(end, law), law))[:, -1, 1:]
    away = np.abs(end.speed[-1] - end.speed[-1, 0])
    asked = left + by_speed * away[1:] + by_leader * away[:-1]
    return MARGIN * largest(asked / by_gap) + ROUNDING.gap_m
