"""Crawling or standing still must not pay: the returns of drivers that do, until the time-out."""

from __future__ import annotations

import pytest
import torch
from reference.worlds import environment, step

from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.errors import UserError
from ganlane.settings.env import EnvConfig, check_reward
from ganlane.sim.random import Stream
from ganlane.transforms import RewardParameters, RewardTransform
from ganlane.transforms.reward import speed_reward

MEANT_MPS = 25.0
#: Rows of one batch, all of which keep their lane: normal; wanting 1 m/s; wanting 0.1 m/s; behind a
#: column at 1 m/s.
NORMAL = slice(0, 4)
CRAWLING = slice(4, 6)
PARKING = slice(6, 8)
STUCK = slice(8, 11)
ROWS = 11


def slowed(env: HighwayEnv):
    """The start of the episodes, with the slow ones slowed and a car of the column in the lane of
    the stuck.
    """
    td = env.reset()
    cars = td[keys.VEHICLES]
    cars["desired_speed"][CRAWLING, 0] = 1.0
    cars["desired_speed"][PARKING, 0] = 0.1
    cars["desired_speed"][STUCK, 1:] = 1.0
    cars["speed"][STUCK, 1:] = 1.0
    for name in ("y", "target_lane"):
        cars[name][STUCK, -1] = cars[name][STUCK, 0]
    cars["x"][STUCK, -1] = cars["x"][STUCK].amax(1) + 25.0
    return td


def pay(td) -> torch.Tensor:
    """Of an ego that is meant to drive 25 m/s, whatever it wants; [ROWS]."""
    meant = td.clone()
    meant[keys.VEHICLES, "desired_speed"][:, 0] = MEANT_MPS
    return sum(RewardTransform(1.0).terms(meant).values())[:, 0]


def drive(goal_m: float, timeout_s: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """What every row's episode paid, its seconds, and whether it reached the goal, each [ROWS]."""
    others = {"mobil": False, "dtype": torch.float32, "stream": Stream.REPORT}
    env = environment(num_envs=ROWS, goal_m=goal_m, timeout_s=timeout_s, **others)
    td = slowed(env)
    driving = torch.ones(ROWS, dtype=torch.bool)
    paid = torch.zeros(ROWS)
    seconds = torch.zeros(ROWS)
    goal = torch.zeros(ROWS, dtype=torch.bool)
    while driving.any():
        td = step(env, td)
        paid += torch.where(driving, pay(td), 0.0)
        seconds += driving
        goal |= driving & td[keys.EVENTS, "goal"][:, 0]
        driving &= ~td["done"][:, 0]
    return paid, seconds, goal


@pytest.mark.parametrize(
    ("goal_m", "timeout_s", "normal", "slow"),
    [
        (1000.0, 200.0, 50.0, -200.0),  # a fifth of the way, in a fifth of the time
        pytest.param(5000.0, 1000.0, 200.0, -1350.0, marks=pytest.mark.slow),
    ],
)
def test_who_crawls_stands_or_waits_behind_a_stalled_column_earns_far_less_than_who_keeps_its_lane(
    goal_m, timeout_s, normal, slow
):
    """At v m/s a crawl earns (v - 15) / 10 a second."""
    paid, seconds, goal = drive(goal_m, timeout_s)
    assert goal.tolist() == [True] * 4 + [False] * 7
    assert (seconds[4:] == timeout_s).all()
    for rows, speed in ((CRAWLING, 1.0), (PARKING, 0.1), (STUCK, 1.0)):
        expected = timeout_s * (speed - 15.0) / 10.0
        # It starts at 10 to 15 m/s, and the first seconds cost less; -10 for a soft crash behind
        # the column.
        assert ((paid[rows] - expected).abs() < 30.0).all()
    # Known weakness: below 15 m/s every second costs, so leaving the road at once is cheaper than
    # living on.
    assert (paid[4:] < RewardParameters().out_of_road).all()
    assert (paid[NORMAL] > normal).all()
    assert (paid[4:] < slow).all()


def test_an_ego_meant_to_drive_no_faster_than_15_mps_would_be_paid_for_crawling_and_is_refused():
    standing = torch.zeros(1)
    assert speed_reward(standing + 1.0, standing + 1.0, standing).item() == pytest.approx(1.0)
    with pytest.raises(UserError, match="ego_desired_speed_mps=1"):
        check_reward(EnvConfig(ego_desired_speed_mps=1.0), RewardParameters())
