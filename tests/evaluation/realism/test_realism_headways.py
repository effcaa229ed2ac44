"""Headways at recorded starts: drivers follow as closely as they are seen to."""

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from ganlane.evaluation.realism.drivers import HeadwayIdm
from ganlane.evaluation.realism.headways import balanced_headways, with_shown_headways
from ganlane.evaluation.realism.recordings import Recording
from ganlane.evaluation.realism.simulation import StartOptions, drive_recordings
from ganlane.sim.following import following_acceleration
from ganlane.sim.neighbours import perceive
from ganlane.sim.road import Road
from ganlane.sim.vehicles import Vehicles

ROAD = Road()
DRAWN = 9.0


def queue(x, speed=10.0, desired=20.0):
    """One row of vehicles of 4 m in the first lane; index 0 is nobody."""
    position = torch.tensor([[-500.0, *x]])
    same = torch.full_like(position, speed)
    lane = torch.zeros(position.shape, dtype=torch.int64)
    return Vehicles(
        x=position, y=0.0 * same, heading=0.0 * same, speed=same, acceleration=0.0 * same, length=0.0 * same + 4.0,
        width=0.0 * same + 2.0, desired_speed=torch.full_like(position, desired), target_lane=lane,
        visibility=lane, valid=torch.tensor([[False, *[True] * len(x)]]),
    )  # fmt: skip


def headways(vehicles):
    return balanced_headways(vehicles, ROAD, torch.full_like(vehicles.x, DRAWN))[0, 1:].tolist()


def test_a_follower_at_20_m_and_10_m_per_s_shows_a_headway_of_1_74_s():
    behind, ahead = headways(queue([0.0, 24.0]))
    # (20 m sqrt(1 - (10 / 20)^4) - 2 m) / (10 m/s)
    assert behind == pytest.approx((20.0 * math.sqrt(15.0 / 16.0) - 2.0) / 10.0, abs=1e-4)
    assert ahead == DRAWN


def test_with_the_headway_that_it_shows_idm_neither_speeds_up_nor_brakes():
    vehicles = queue([0.0, 12.0, 40.0, 60.0])
    shown = balanced_headways(vehicles, ROAD, torch.ones_like(vehicles.x))
    acceleration = following_acceleration(perceive(vehicles, ROAD), headway_s=shown)
    assert acceleration[0, 1:4].abs().max() < 1e-4


def test_whoever_is_far_behind_has_shown_none_and_nobody_follows_closer_than_a_tenth_of_a_second():
    assert headways(queue([0.0, 64.0]))[0] == DRAWN
    assert headways(queue([0.0, 5.0]))[0] == pytest.approx(0.1)


def test_only_those_who_enter_are_credited_and_other_memories_stay_as_they_are():
    vehicles = queue([0.0, 24.0, 48.0])
    drawn = torch.full_like(vehicles.x, DRAWN)
    memory = TensorDict({"driver": TensorDict({"headway": drawn, "noise": drawn}, [1]), "wish": drawn}, [1])
    who = torch.tensor([[False, True, False, False]])
    after = with_shown_headways(memory, vehicles, ROAD, who)
    assert after["driver", "headway"][0, 1] < 3.0
    assert (after["driver", "headway"][0, 2:] == DRAWN).all()
    assert torch.equal(after["driver", "noise"], drawn)
    assert torch.equal(after["wish"], drawn)
    assert (memory["driver", "headway"] == DRAWN).all()


def test_a_recorded_platoon_keeps_its_gaps_behind_a_leader_at_constant_speed():
    time = np.arange(60)[:, None] * 0.1
    x = np.array([0.0, 12.0, 40.0, 55.0]) + 10.0 * time
    size = np.ones(4)
    driven = np.array([True, True, True, False])
    dense = (x, 0 * x, 0 * x + 10.0, x > -1)
    scene = Recording("platoon", "platoon", 1, 4.0, *dense, 4 * size, 2 * size, driven)
    there = drive_recordings(HeadwayIdm, [scene], StartOptions(desired_above_mps=5.0))
    ends = there.filter(there["frame"] == 59).sort("vehicle")["x"].to_numpy()
    assert np.abs(ends - x[59]).max() < 0.01
