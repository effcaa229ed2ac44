"""IDM and car following against values worked by hand."""

from __future__ import annotations

import pytest
import torch
from reference.worlds import DOUBLE, vehicles

from ganlane.sim.idm import desired_gap, equilibrium_gap, following_acceleration, idm_acceleration
from ganlane.sim.neighbours import FREE_GAP_M, perceive
from ganlane.sim.state import Road

# 2 sqrt(a b) = 2 sqrt(0.7 * 1.7) = 2.181742423; (20 / 25)^4 = 0.4096
BY_HAND = [
    # v, v0, gap, leader's v, acceleration
    (20.0, 25.0, FREE_GAP_M, 20.0, 0.413271908),  # 0.7 (1 - 0.4096 - (34 / 10000)^2)
    (0.0, 25.0, FREE_GAP_M, 0.0, 0.699999972),  # 0.7 (1 - (2 / 10000)^2)
    (20.0, 25.0, 50.0, 15.0, -1.371332226),  # s* = 2 + 32 + 100 / 2.1817 = 79.83493; 0.7 (0.5904 - 2.549446)
    (20.0, 25.0, 10.0, 40.0, 0.38528),  # the dynamic part is not negative: s* = 2; 0.7 (0.5904 - 0.04)
    (0.0, 25.0, 2.0, 0.0, 0.0),  # standing at the minimum gap
    (0.0, 25.0, 1.0, 0.0, -2.1),  # 0.7 (1 - 4)
    (25.0, 25.0, FREE_GAP_M, 25.0, -0.00001234800),  # at the desired speed, -0.7 (42 / 10000)^2
    (20.0, 25.0, 5.0, 0.0, -20.0),  # far beyond the strongest braking
    (1.0, 25.0, -3.0, 0.0, -20.0),  # an overlap
]


@pytest.mark.parametrize(("speed", "desired", "gap", "leader", "expected"), BY_HAND)
def test_idm_gives_the_values_worked_by_hand(speed, desired, gap, leader, expected):
    speed, gap, leader = (torch.tensor(value, dtype=DOUBLE) for value in (speed, gap, leader))
    assert idm_acceleration(speed, desired, gap, leader).item() == pytest.approx(expected, abs=2e-7)


def test_the_desired_gap_at_20_mps_is_the_headway_plus_two_metres():
    speed = torch.tensor(20.0, dtype=DOUBLE)
    assert desired_gap(speed, torch.zeros_like(speed)).item() == pytest.approx(2.0 + 1.6 * 20.0)
    assert desired_gap(speed, torch.zeros_like(speed), headway_s=0.8).item() == pytest.approx(2.0 + 0.8 * 20.0)


def test_nobody_accelerates_at_the_equilibrium_gap():
    speed = torch.linspace(1.0, 24.0, 24, dtype=DOUBLE)
    gap = equilibrium_gap(speed, 25.0)
    assert idm_acceleration(speed, 25.0, gap, speed).abs().max() < 1e-12
    # (2 + 15 * 1.6) / sqrt(1 - 0.6^4) = 26 / sqrt(0.8704)
    assert equilibrium_gap(torch.tensor(15.0, dtype=DOUBLE), 25.0).item() == pytest.approx(27.868520)


def test_in_the_middle_of_a_change_the_more_demanding_leader_counts():
    near = {"x": 30.0, "lane": 1, "speed": 10.0}
    far = {"x": 60.0, "lane": 0, "speed": 20.0}
    alone = idm_acceleration(*(torch.tensor(v, dtype=DOUBLE) for v in (20.0, 25.0, 25.5, 10.0)))
    changing = vehicles({"x": 0.0, "y": 0.0, "target_lane": 1}, near, far)
    assert following_acceleration(perceive(changing, Road(lanes=2)))[0, 0] == alone
    keeping = vehicles({"x": 0.0, "lane": 0}, near, far)
    assert following_acceleration(perceive(keeping, Road(lanes=2)))[0, 0] > alone
