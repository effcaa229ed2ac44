"""IDM against values worked by hand, whom it can save, and against the linear theory on platoons
and rings.

The theory is that of ``tests/reference/stability.py``; the simulation is the package's own traffic.
"""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from reference import stability
from reference.worlds import DOUBLE, moves, vehicles_at

from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.idm import (
    TABLE_V,
    can_brake,
    desired_gap,
    equilibrium_gap,
    idm_acceleration,
    least_gap,
    needed_deceleration,
)
from ganlane.sim.neighbours import FREE_GAP_M
from ganlane.sim.state import Road
from ganlane.traffic.idm_mobil import IdmTraffic

# 2 sqrt(a b) = 2 sqrt(0.7 * 1.7) = 2.181742423; (20 / 25)^4 = 0.4096
BY_HAND = [
    # v, v0, gap, leader's v, acceleration
    (20.0, 25.0, FREE_GAP_M, 20.0, 0.413271908),  # 0.7 (1 - 0.4096 - (34 / 10000)^2)
    (0.0, 25.0, FREE_GAP_M, 0.0, 0.699999972),  # 0.7 (1 - (2 / 10000)^2)
    # s* = 2 + 32 + 100 / 2.1817 = 79.83493; 0.7 (0.5904 - 2.549446)
    (20.0, 25.0, 50.0, 15.0, -1.371332226),
    # the dynamic part is not negative: s* = 2; 0.7 (0.5904 - 0.04)
    (20.0, 25.0, 10.0, 40.0, 0.38528),
    (0.0, 25.0, 2.0, 0.0, 0.0),  # standing at the minimum gap
    (0.0, 25.0, 1.0, 0.0, -2.1),  # 0.7 (1 - 4)
    (25.0, 25.0, FREE_GAP_M, 25.0, -0.00001234800),  # at the desired speed, -0.7 (42 / 10000)^2
    (20.0, 25.0, 5.0, 0.0, -20.0),  # far beyond the strongest braking
    (1.0, 25.0, -3.0, 0.0, -20.0),  # an overlap
]


def doubles(*values):
    return [torch.tensor(value, dtype=DOUBLE) for value in values]


@pytest.mark.parametrize(("speed", "desired", "gap", "leader", "expected"), BY_HAND)
def test_idm_gives_the_values_worked_by_hand(speed, desired, gap, leader, expected):
    speed, gap, leader = doubles(speed, gap, leader)
    assert idm_acceleration(speed, desired, gap, leader).item() == pytest.approx(expected, abs=2e-7)


def test_nobody_accelerates_at_the_equilibrium_gap():
    speed = torch.linspace(1.0, 24.0, 24, dtype=DOUBLE)
    gap = equilibrium_gap(speed, 25.0)
    assert idm_acceleration(speed, 25.0, gap, speed).abs().max() < 1e-12
    # (2 + 15 * 1.6) / sqrt(1 - 0.6^4) = 26 / sqrt(0.8704)
    assert equilibrium_gap(*doubles(15.0), 25.0).item() == pytest.approx(27.868520)


# Braking


def test_a_stop_needs_its_speed_squared_over_twice_the_gap():
    assert needed_deceleration(*doubles(20.0, 0.0, 10.0)).item() == pytest.approx(20.0)
    assert needed_deceleration(*doubles(10.0, 20.0, 0.5)).item() == 0.0


@pytest.mark.parametrize("speed", [2.0, 5.0, 12.0, 25.0, 36.0])
def test_idm_stops_within_the_kinematic_distance_and_a_step(speed):
    """At a closer gap the hardest braking cannot help; IDM asks for it from the first step on."""
    kinematic = speed * speed / (-2.0 * TABLE_V.min_acceleration)
    gap = least_gap(speed, 0.0, 36.0)
    assert kinematic <= gap <= kinematic + 0.05 * speed + 0.2
    assert not can_brake(0.95 * kinematic - 0.05, speed, 0.0, 36.0)


# Platoons behind a leader of constant speed settle at the analytic equilibrium gap, every one of
# their cars.

DESIRED = 25.0
FOLLOWERS = 5
LENGTH_M = 4.5
SPEEDS = (1.0, 3.0, 6.0, 10.0, 15.0)
EQUILIBRIUM_M = torch.tensor([[stability.equilibrium(v, DESIRED)] for v in SPEEDS], dtype=DOUBLE)
#: Start of every platoon: bumper to bumper gap, m, and speed, m/s (or the leader's, if that is
#: lower).
START_GAP_M = 40.0
START_SPEED = 12.0
TOLERANCE_M = 1e-6


def leaders_wish(speed):
    """Desired speed with which IDM on an empty lane holds ``speed``.

    ``1 = (v/v0)^4 + (s*/10 000 m)^2``.
    """
    interaction = desired_gap(speed, torch.zeros_like(speed)) / FREE_GAP_M
    return speed / (1.0 - interaction * interaction) ** 0.25


def platoons():
    """One platoon per speed, [len(SPEEDS), 1 + FOLLOWERS]; the leader already drives its speed."""
    speed = torch.tensor(SPEEDS, dtype=DOUBLE)[:, None]
    order = torch.arange(1 + FOLLOWERS).expand(len(SPEEDS), -1)
    leads = order == 0
    return vehicles_at(
        -(START_GAP_M + LENGTH_M) * order.to(DOUBLE),
        torch.zeros_like(order),
        speed=torch.where(leads, speed, speed.clamp_max(START_SPEED)),
        desired_speed=torch.where(leads, leaders_wish(speed), DESIRED),
    )


def test_every_car_of_a_platoon_settles_at_the_equilibrium_gap():
    """Within four minutes: a minute to come near, and three for what linear theory leaves."""
    *_, settled = moves(IdmTraffic(Road(lanes=1)), platoons(), 2400)
    gaps = settled.x[:, :-1] - settled.x[:, 1:] - LENGTH_M
    assert (gaps - EQUILIBRIUM_M).abs().max() < TOLERANCE_M
    assert (settled.speed - torch.tensor(SPEEDS)[:, None]).abs().max() < TOLERANCE_M


def test_nobody_touches_the_car_ahead_on_the_way_there():
    """From far more than the equilibrium gap, and from far less: a tenth of it."""
    start = platoons()
    order = torch.arange(1 + FOLLOWERS, dtype=DOUBLE)
    close = start.with_(
        x=-(0.1 * EQUILIBRIUM_M + LENGTH_M) * order, speed=start.speed[:, :1].expand_as(start.x)
    )
    for cars in moves(IdmTraffic(Road(lanes=1)), close, 600):
        assert (cars.x[:, :-1] - cars.x[:, 1:] - LENGTH_M).min() > 0.0


# On a ring road, below the speed that linear theory gives, Table V's drivers turn any disturbance
# into waves.

CARS = 50
SPACING_M = 45.0
#: (desired speed, speed), 1.5 m/s below and above the critical speed of each.
CASES = [(v0, stability.critical_speed(v0) + side) for v0 in (18.0, 25.0) for side in (-1.5, 1.5)]
RING = IdmTraffic(Road(lanes=1, ring_m=CARS * SPACING_M))


def disturbed_rings(displacement, speed):
    """The four cases, [4, CARS], each in equilibrium but for a displacement (m) and a speed (m/s).

    All rings are of the same length: where the gap is smaller the cars are longer. Only gaps enter
    IDM.
    """
    desired, cruise = torch.tensor(CASES, dtype=DOUBLE).T[:, :, None].expand(2, 4, CARS)
    gaps = torch.tensor([stability.equilibrium(v, v0) for v0, v in CASES], dtype=DOUBLE)
    return vehicles_at(
        -SPACING_M * torch.arange(CARS, dtype=DOUBLE) + torch.from_numpy(displacement),
        torch.zeros((4, CARS), dtype=torch.int64),
        speed=cruise + torch.from_numpy(speed),
        length=SPACING_M - gaps[:, None].expand(4, CARS),
        desired_speed=desired,
    )


def deviations(cars, steps):
    """(displacement, speed) from the equilibrium after every one of the steps, [4, 2 CARS]."""
    cruise = torch.tensor([[v] for _, v in CASES], dtype=DOUBLE)
    steps_away = []
    for step, after in enumerate(moves(RING, cars, steps), 1):
        there = -SPACING_M * torch.arange(CARS, dtype=DOUBLE) + cruise * (step * PHYSICS_STEP_S)
        steps_away.append(torch.cat((after.x - there, after.speed - cruise), dim=1).numpy())
    return steps_away


@pytest.mark.parametrize(("desired", "speed"), CASES)
def test_the_slopes_of_the_theory_are_those_of_the_package(desired, speed):
    values = (stability.equilibrium(speed, desired), speed, speed)
    gap, its_speed, leader = (
        torch.tensor(value, dtype=DOUBLE, requires_grad=True) for value in values
    )
    idm_acceleration(its_speed, desired, gap, leader).backward()
    assert (gap.grad.item(), its_speed.grad.item(), leader.grad.item()) == pytest.approx(
        stability.slopes(speed, desired)
    )


@pytest.mark.parametrize(("desired", "critical"), [(18.0, 12.1), (25.0, 17.3)])
def test_the_critical_speed_of_linear_theory(desired, critical):
    """Neither the time step nor the size of the ring moves it by as much as is tested below."""
    threshold = stability.critical_speed(desired)
    assert threshold == pytest.approx(critical, abs=0.05)
    # One change of sign: unstable all the way down.
    signs = [stability.instability(v, desired) > 0.0 for v in np.linspace(0.1, 0.99 * desired, 200)]
    assert sum(one != other for one, other in pairwise(signs)) == 1
    # 400 cars in steps of 0.1 s: within 0.01 m/s. 50 are too few for the longest waves: 0.2 to 0.3
    # lower.
    for cars, tolerance in ((400, 0.01), (CARS, 0.35)):
        below, above = (
            stability.growth_rate(speed, desired, cars, PHYSICS_STEP_S)[0]
            for speed in (threshold - tolerance, threshold + tolerance)
        )
        assert below > 0.0 > above


def test_every_ring_grows_or_decays_at_the_rate_of_the_linear_theory():
    """The fastest wave of each case, alone, of 0.1 mm.

    After 60 s its size and phase are those of its eigenvalue.
    """
    steps = 600
    size = 1e-4
    numbers = np.arange(CARS)
    waves = []
    for desired, speed in CASES:
        k = 2.0 * math.pi * stability.growth_rate(speed, desired, CARS, PHYSICS_STEP_S)[1] / CARS
        waves.append((np.exp(1j * k * numbers), *stability.wave(speed, desired, k, PHYSICS_STEP_S)))
    shape, factor, ratio = (np.array(column) for column in zip(*waves))
    cars = disturbed_rings((size * shape).real, (size * ratio[:, None] * shape).real)
    after = deviations(cars, steps)[-1][:, :CARS]
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
    away = deviations(disturbed_rings(displacement, np.zeros_like(displacement)), steps)
    for case, (desired, speed) in enumerate(CASES):
        ahead = np.roll(np.eye(CARS), 1, axis=0)
        matrix = stability.step_matrix(speed, desired, ahead, PHYSICS_STEP_S)
        expected = np.linalg.matrix_power(matrix, steps) @ np.append(
            displacement[case], np.zeros(CARS)
        )
        error = np.abs(away[-1][case] - expected).max()
        assert error < 0.01 * np.abs(expected).max()
    growth = away[-1][:, CARS:].std(axis=1) / away[2999][:, CARS:].std(axis=1)
    assert (growth[[0, 2]] > 2.0).all()
    assert (growth[[1, 3]] < 0.5).all()
