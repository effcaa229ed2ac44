"""A ring road: below the speed that linear theory gives, Table V's drivers turn any disturbance into waves.

The theory stands in ``tests/reference/stability.py``; the simulation is the package's own traffic.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from reference import stability
from reference.worlds import DOUBLE

from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.idm import idm_acceleration
from ganlane.sim.state import Road, Vehicles
from ganlane.traffic.idm_mobil import IdmTraffic

CARS = 50
SPACING_M = 45.0
DESIRED = (18.0, 25.0)
#: (desired speed, speed), 1.5 m/s below and above the critical speed of each.
CASES = [(v0, stability.critical_speed(v0) + side) for v0 in DESIRED for side in (-1.5, 1.5)]
ROAD = Road(lanes=1, ring_m=CARS * SPACING_M)


def disturbed_rings(displacement: np.ndarray, speed: np.ndarray) -> Vehicles:
    """The four cases, [4, CARS], each in equilibrium but for a displacement (m) and a speed (m/s).

    All rings are of the same length: where the gap is smaller the cars are longer. Only gaps enter IDM.
    """
    desired, cruise = torch.tensor(CASES, dtype=DOUBLE).T[:, :, None].expand(2, 4, CARS)
    gaps = torch.tensor([stability.equilibrium(v, v0) for v0, v in CASES], dtype=DOUBLE)
    x = -SPACING_M * torch.arange(CARS, dtype=DOUBLE) + torch.from_numpy(displacement)
    zero, lane = torch.zeros_like(x), torch.zeros((4, CARS), dtype=torch.int64)
    length = SPACING_M - gaps[:, None].expand(4, CARS)
    speed = cruise + torch.from_numpy(speed)
    return Vehicles(x, zero, zero, speed, zero, length, zero + 2.5, desired, lane, lane, lane == 0)


def drive(cars: Vehicles, steps: int) -> Vehicles:
    traffic = IdmTraffic(ROAD)
    memory = traffic.fresh_memory(cars, torch.zeros(4, dtype=torch.int64))
    clock = torch.zeros(4, dtype=torch.int64)
    for _ in range(steps):
        cars, memory = traffic.move(cars, memory, clock, clock)
    return cars


def deviation(cars: Vehicles, steps: int) -> np.ndarray:
    """(displacement, speed) from the equilibrium after ``steps``, [4, 2 CARS]."""
    cruise = torch.tensor([[v] for _, v in CASES], dtype=DOUBLE)
    there = -SPACING_M * torch.arange(CARS, dtype=DOUBLE) + cruise * (steps * PHYSICS_STEP_S)
    return torch.cat((cars.x - there, cars.speed - cruise), dim=1).numpy()


# The theory


@pytest.mark.parametrize(("desired", "speed"), CASES)
def test_the_slopes_are_those_of_the_package(desired, speed):
    values = (stability.equilibrium(speed, desired), speed, speed)
    gap, own, leader = (torch.tensor(value, dtype=DOUBLE, requires_grad=True) for value in values)
    idm_acceleration(own, desired, gap, leader).backward()
    assert (gap.grad.item(), own.grad.item(), leader.grad.item()) == pytest.approx(stability.slopes(speed, desired))


@pytest.mark.parametrize(("desired", "critical"), [(18.0, 12.1), (25.0, 17.3)])
def test_the_critical_speed_of_linear_theory(desired, critical):
    assert stability.critical_speed(desired) == pytest.approx(critical, abs=0.05)
    # One change of sign: unstable all the way down.
    signs = [stability.instability(v, desired) > 0.0 for v in np.linspace(0.1, 0.99 * desired, 200)]
    assert sum(one != other for one, other in pairwise(signs)) == 1


@pytest.mark.parametrize("desired", DESIRED)
def test_neither_the_time_step_nor_the_size_of_the_ring_moves_it_by_as_much_as_is_tested(desired):
    """400 cars in steps of 0.1 s: within 0.01 m/s. 50 are too few for the longest waves: 0.2 to 0.3 lower."""
    critical = stability.critical_speed(desired)
    for cars, tolerance in ((400, 0.01), (CARS, 0.35)):
        found = stability.zero_of(
            lambda v, cars=cars: stability.growth_rate(v, desired, cars, PHYSICS_STEP_S)[0],
            critical - 1.5,
            critical + 1.5,
        )
        assert found == pytest.approx(critical, abs=tolerance)


# The simulation


def test_every_ring_grows_or_decays_at_the_rate_of_the_linear_theory():
    """The fastest wave of each case, alone, of 0.1 mm: after 60 s its size and phase are those of its eigenvalue."""
    steps, size = 600, 1e-4
    numbers, waves = np.arange(CARS), []
    for desired, speed in CASES:
        k = 2.0 * math.pi * stability.growth_rate(speed, desired, CARS, PHYSICS_STEP_S)[1] / CARS
        waves.append((np.exp(1j * k * numbers), *stability.wave(speed, desired, k, PHYSICS_STEP_S)))
    shape, factor, ratio = (np.array(column) for column in zip(*waves))
    cars = disturbed_rings((size * shape).real, (size * ratio[:, None] * shape).real)
    after = deviation(drive(cars, steps), steps)[:, :CARS]
    amplitude = 2.0 / CARS * (after * shape.conj()).sum(1) / size
    # The next order of the disturbance is smaller by its size over the gap: 1e-4 m / 20 m.
    np.testing.assert_allclose(amplitude, factor**steps, rtol=2e-5)
    grown = np.abs(amplitude) > 1.0
    assert grown.tolist() == [True, False, True, False]


@pytest.mark.slow
def test_in_1500_s_a_small_disturbance_grows_below_the_critical_speed_and_dies_above_it():
    """Random displacements of all cars; the outcome is the linear theory's, car by car."""
    steps = 15_000
    displacement = 1e-4 * np.random.default_rng(0).standard_normal((4, CARS))
    start = disturbed_rings(displacement, np.zeros_like(displacement))
    ends = {}
    cars, done = start, 0
    for seconds in (300, 1500):
        cars, done = drive(cars, seconds * 10 - done), seconds * 10
        ends[seconds] = deviation(cars, done)
    for case, (desired, speed) in enumerate(CASES):
        matrix = stability.step_matrix(speed, desired, CARS, PHYSICS_STEP_S, ring=True)
        expected = np.linalg.matrix_power(matrix, steps) @ np.append(displacement[case], np.zeros(CARS))
        error = np.abs(ends[1500][case] - expected).max()
        assert error < 0.01 * np.abs(expected).max()
    spread = {seconds: end[:, CARS:].std(axis=1) for seconds, end in ends.items()}
    growth = spread[1500] / spread[300]
    assert (growth[[0, 2]] > 2.0).all()
    assert (growth[[1, 3]] < 0.5).all()
