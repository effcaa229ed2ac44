"""Platoons behind a leader of constant speed settle at the analytic equilibrium gap, every one of their cars.

How long that takes follows from the linear theory (``tests/reference/stability.py``), not from a look at the run.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference import stability
from reference.worlds import DOUBLE

from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.idm import desired_gap, equilibrium_gap
from ganlane.sim.neighbours import FREE_GAP_M
from ganlane.sim.state import Road, Vehicles
from ganlane.traffic.idm_mobil import IdmTraffic

DESIRED, FOLLOWERS, LENGTH_M = 25.0, 9, 4.5
SPEEDS = (1.0, 3.0, 6.0, 10.0, 15.0, 18.0, 20.0)
#: Start of every platoon: bumper to bumper gap, m, and speed, m/s (or the leader's, if that is lower).
START_GAP_M, START_SPEED = 40.0, 12.0
TOLERANCE_M = 1e-6


def leaders_wish(speed: torch.Tensor) -> torch.Tensor:
    """Desired speed with which IDM on an empty lane holds ``speed``: ``1 = (v/v0)^4 + (s*/10 000 m)^2``."""
    interaction = desired_gap(speed, torch.zeros_like(speed)) / FREE_GAP_M
    return speed / (1.0 - interaction * interaction) ** 0.25


def platoons() -> Vehicles:
    """One platoon per speed, [len(SPEEDS), 1 + FOLLOWERS]; the leader already drives its speed."""
    speed = torch.tensor(SPEEDS, dtype=DOUBLE)[:, None]
    order = torch.arange(1 + FOLLOWERS).expand(len(SPEEDS), -1)
    leads = order == 0
    x = -(START_GAP_M + LENGTH_M) * order.to(DOUBLE)
    zero, lane = torch.zeros_like(x), torch.zeros_like(order)
    return Vehicles(
        x=x,
        y=zero,
        heading=zero,
        speed=torch.where(leads, speed, speed.clamp_max(START_SPEED)),
        acceleration=zero,
        length=zero + LENGTH_M,
        width=zero + 2.5,
        desired_speed=torch.where(leads, leaders_wish(speed), DESIRED),
        target_lane=lane,
        visibility=lane,
        valid=order >= 0,
    )


def decay(speed: float, steps: int) -> float:
    """By how much ``steps`` steps multiply a platoon's deviations (m, m/s) from equilibrium, at most."""
    matrix = stability.step_matrix(speed, DESIRED, FOLLOWERS, PHYSICS_STEP_S, ring=False)
    return float(np.linalg.norm(np.linalg.matrix_power(matrix, steps), 2))


def settling_steps(speed: float) -> int:
    """Steps after which a deviation as large as at the start is below a tenth of the tolerance."""
    away_m = np.arange(1, FOLLOWERS + 1) * (START_GAP_M - stability.equilibrium(speed, DESIRED))
    away_mps = np.full(FOLLOWERS, speed - min(speed, START_SPEED))
    start = float(np.linalg.norm(np.concatenate((away_m, away_mps))))
    steps = 100
    while decay(speed, steps) * start > 0.1 * TOLERANCE_M:
        steps = round(1.2 * steps)
    return steps


@pytest.fixture(scope="module")
def settled() -> Vehicles:
    """The platoons after the settling time of the slowest; before they are near, they get a minute."""
    traffic, cars = IdmTraffic(Road(lanes=1)), platoons()
    clock = torch.zeros(len(SPEEDS), dtype=torch.int64)
    memory = traffic.fresh_memory(cars, clock)
    for _ in range(600 + max(settling_steps(speed) for speed in SPEEDS)):
        cars, memory = traffic.move(cars, memory, clock, clock)
    return cars


@pytest.mark.parametrize("row", range(len(SPEEDS)), ids=[f"{speed:g} m/s" for speed in SPEEDS])
def test_every_car_of_a_platoon_settles_at_the_equilibrium_gap(settled, row):
    gaps = settled.x[row, :-1] - settled.x[row, 1:] - LENGTH_M
    expected = stability.equilibrium(SPEEDS[row], DESIRED)
    assert (gaps - expected).abs().max() < TOLERANCE_M
    assert (settled.speed[row] - SPEEDS[row]).abs().max() < TOLERANCE_M


@pytest.mark.parametrize("speed", SPEEDS)
def test_the_packages_equilibrium_gap_is_the_papers(speed):
    found = equilibrium_gap(torch.tensor(speed, dtype=DOUBLE), DESIRED).item()
    assert found == pytest.approx(stability.equilibrium(speed, DESIRED), rel=1e-12)


def test_nobody_touches_the_car_ahead_on_the_way_there():
    """From far more than the equilibrium gap, and from far less: a tenth of it."""
    traffic, cars = IdmTraffic(Road(lanes=1)), platoons()
    gaps = torch.tensor([0.1 * stability.equilibrium(v, DESIRED) for v in SPEEDS], dtype=DOUBLE)[:, None]
    order = torch.arange(1 + FOLLOWERS, dtype=DOUBLE)
    cars = cars.with_(x=-(gaps + LENGTH_M) * order, speed=cars.speed[:, :1].expand_as(cars.speed).clone())
    clock = torch.zeros(len(SPEEDS), dtype=torch.int64)
    memory = traffic.fresh_memory(cars, clock)
    closest = torch.inf
    for _ in range(600):
        cars, memory = traffic.move(cars, memory, clock, clock)
        closest = min(closest, (cars.x[:, :-1] - cars.x[:, 1:] - LENGTH_M).min().item())
    assert closest > 0.0
