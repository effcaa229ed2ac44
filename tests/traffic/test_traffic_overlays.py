"""Overlays on traffic: lane changes, accelerations, guard."""

import math

import pytest
import torch
from reference.foreign import beyond_the_edge, others_of, overlaps

from ganlane.env import EpisodeParameters, HighwayEnv
from ganlane.sim import Vehicles, pair_overlaps
from ganlane.traffic import (
    AccelerationOverlay,
    CalibratedLaneChange,
    Guard,
    IdmTraffic,
    LiteralChanges,
    LiteralLaneChange,
    SuddenAccelerations,
    TrafficModule,
    TrafficSequential,
)
from ganlane.traffic.overlays import literal_hazard


class Drift(TrafficModule):
    """A network gone wrong: drifts to the left and accelerates for ever."""

    def __init__(self, lateral=1.0, acceleration=2.0):
        super().__init__()
        self.lateral = lateral
        self.acceleration = acceleration

    def move(self, vehicles, memory, key, step):
        speed = vehicles.speed + self.acceleration * self.dt
        y = vehicles.y + self.lateral * self.dt
        return vehicles.with_(x=vehicles.x + speed * self.dt, y=y, speed=speed), memory


def run(rows, vehicles, seconds, base, **overlays):
    """What :func:`reference.foreign.others_of` says of a chain."""
    traffic = TrafficSequential({"base": base, **overlays})
    return others_of(traffic, rows, seconds, vehicles)


def test_the_mean_wait_of_equation_10_is_the_root_of_half_pi_t_m_and_not_t_m():
    t_m = 2218.0
    draws = torch.Generator().manual_seed(0)
    wait = torch.full((20_000,), torch.nan)
    for clock in torch.arange(400.0):
        starts = torch.rand(20_000, generator=draws) < literal_hazard(clock, t_m)
        wait = torch.where(wait.isnan() & starts, clock, wait)
    assert not wait.isnan().any()
    assert wait.mean().item() == pytest.approx(math.sqrt(math.pi * t_m / 2), rel=0.02)


def test_literal_changes_end_on_a_lane_centre_at_their_own_lateral_speed_and_restart_the_clock():
    changes = LiteralChanges(mean_steps=60.0, lateral_speed_mps=1.0, lateral_speed_sd_mps=0.0)
    others, state = run(32, 6, 20, IdmTraffic(), change=LiteralLaneChange(changes=changes))
    moved = others.y.diff(dim=0).abs()
    fast = moved[moved > 0.05]
    assert len(fast) > 1000
    assert fast.max() <= 0.1 + 1e-3
    clock, pace = (state["traffic", "change", name][:, 1:] for name in ("clock", "lateral_speed"))
    offset = (state["vehicles", "y"] - state["vehicles", "target_lane"] * 4.0).abs()[:, 1:]
    assert offset[(pace == 0) & (clock == 0)].max() < 1e-3
    assert (clock[pace != 0] == 0).all()


def test_calibrated_changes_find_gaps_and_touch_nobody():
    others, _ = run(64, 12, 15, IdmTraffic(), change=CalibratedLaneChange())
    assert (others.target_lane.diff(dim=0) != 0).sum() > 50
    assert overlaps(others) == 0


def test_sudden_accelerations_fill_a_third_of_the_time_with_the_spread_of_the_data():
    # 2 s of waiting and 1 s of acceleration, in turn.
    sudden = SuddenAccelerations(every_s=2.0, lasts_s=1.0, mean=0.0, sd=0.8)
    overlay = AccelerationOverlay(sudden=sudden)
    state = HighwayEnv(IdmTraffic(), num_envs=200).reset()
    state["vehicles", "speed"][:] = 20.0
    episode = state["episode"]
    _, state["traffic"] = overlay.enter(Vehicles.of(state["vehicles"]), episode, episode)
    record = []
    for step in range(300):
        state["step"] = torch.full((200,), step)
        state["moved"] = state["vehicles"].clone()
        record.append(overlay(state)["moved", "acceleration"])
    acceleration = torch.stack(record)
    active = acceleration.abs() > 1e-4
    assert active.float().mean().item() == pytest.approx(1 / 3, abs=0.02)
    assert acceleration[active].std().item() == pytest.approx(0.8, rel=0.05)
    onsets = active[1:] & ~active[:-1]
    assert (active[1:].sum() / onsets.sum()).item() == pytest.approx(10.0, abs=0.6)


def test_the_guard_keeps_a_drifting_network_on_the_road_and_at_a_speed_people_drive():
    others, state = run(32, 9, 20, Drift(), guard=Guard())
    assert beyond_the_edge(others) <= 1e-4
    vehicles = state["vehicles"]
    assert (vehicles["speed"] <= vehicles["desired_speed"] + 0.1).all()
    assert pair_overlaps(Vehicles.of(vehicles)).sum() == 0


def test_the_guard_does_not_let_a_network_that_always_brakes_stand_still():
    others, _ = run(16, 3, 20, Drift(lateral=0.0, acceleration=-3.0), guard=Guard())
    assert others.speed[-1].min() > 4.0


DRIFT = Drift(lateral=0.0)


@pytest.mark.parametrize("traffic", [DRIFT, TrafficSequential({"base": DRIFT, "guard": Guard()})])
def test_a_model_without_memory_drives_through_rollouts_and_resets(traffic):
    env = HighwayEnv(traffic, num_envs=3, episode=EpisodeParameters(goal_m=60.0))
    assert env.rollout(12, break_when_any_done=False)["next", "done"].any()
    again = env.rollout(3, tensordict=env.reset(), auto_reset=False, break_when_any_done=False)
    assert again.shape == (3, 3)
