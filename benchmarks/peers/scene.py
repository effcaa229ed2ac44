"""What is driven: one lane, Table V's drivers, and a leader with a prescribed speed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ganlane.keys import PHYSICS_STEP_S

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
        leader: the foremost vehicle's speed as (time in s, speed in m/s), straight lines between them;
            empty where it drives freely, as everybody else does.
    """

    name: str
    seconds: float
    speeds_mps: tuple[float, ...]
    gaps_m: tuple[float, ...] = ()
    leader: tuple[tuple[float, float], ...] = ()

    def steps(self, dt: float = PHYSICS_STEP_S) -> int:
        """Number of physics steps of ``dt`` seconds."""
        return round(self.seconds / dt)

    def leader_speeds(self, dt: float = PHYSICS_STEP_S) -> Array:
        """The leader's speed at every step, m/s, [steps + 1]."""
        times, speeds = zip(*self.leader)
        return np.interp(np.arange(self.steps(dt) + 1) * dt, times, speeds)

    def positions_m(self) -> Array:
        """Position of each vehicle's centre at the start, m, [M]."""
        return START_M - np.cumsum([0.0, *(gap + LENGTH_M for gap in self.gaps_m)])


@dataclass(frozen=True)
class Trace:
    """What a simulator made of a scene: speed (m/s) and position of the centre (m), [steps + 1, M]."""

    speed: Array
    position: Array

    @property
    def gap(self) -> Array:
        """Net gap ahead of each vehicle but the foremost, m, [steps + 1, M - 1]."""
        return self.position[:, :-1] - self.position[:, 1:] - LENGTH_M


#: Gaps of eight followers that are nobody's equilibrium, m.
UNEVEN_M = (30.0, 60.0, 25.0, 50.0, 35.0, 70.0, 28.0, 45.0)


def platoon(name: str, seconds: float, speed_mps: float, leader: tuple[tuple[float, float], ...]) -> Scene:
    """Eight cars at one speed and at uneven gaps behind a leader."""
    return Scene(name, seconds, (speed_mps,) * 9, UNEVEN_M, leader)


FREE_ROAD = Scene("free road", 120.0, (10.0,))
CONSTANT = platoon("constant leader", 120.0, 15.0, ((0.0, 15.0),))
#: Brakes at 2 m/s2 and speeds up at 0.5 m/s2.
SLOW_AND_GO = platoon("slow and go", 150.0, 20.0, ((0, 20.0), (40, 20.0), (45, 10.0), (80, 10.0), (100, 20.0)))
#: The same change of speed within one physics step.
STEP = platoon("step", 150.0, 20.0, ((0, 20.0), (40, 20.0), (40.1, 10.0), (80, 10.0), (80.1, 20.0)))
OBSTACLE = Scene("standing obstacle", 90.0, (0.0, 20.0), (300.0,), ((0.0, 0.0),))
SCENES = (FREE_ROAD, CONSTANT, SLOW_AND_GO, STEP, OBSTACLE)

#: Speeds at which platoons are left to settle, m/s.
SETTLED_MPS = (5.0, 10.0, 15.0)


def settling(speed_mps: float) -> Scene:
    """A platoon that is given 450 s to settle behind a leader at constant speed."""
    return platoon(f"settling at {speed_mps:g} m/s", 450.0, speed_mps, ((0.0, speed_mps),))
