"""Overlays on traffic: lane changes, accelerations, guard."""

import math

import pytest
import torch
from tensordict import TensorDict

from ganlane.env import EpisodeParameters, HighwayEnv
from ganlane.sim import Road, Vehicles, pair_overlaps
from ganlane.sim.state import lateral_half_extent
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
from ganlane.traffic.lane_change import distance_hazard, literal_hazard, random_side


class Drift(TrafficModule):
    """A network gone wrong: drifts to the left and accelerates for ever."""

    def __init__(self, road=None, lateral=1.0, acceleration=2.0):
        super().__init__(road)
        self.lateral, self.acceleration = lateral, acceleration

    def move(self, vehicles, memory, key, step):
        speed = vehicles.speed + self.acceleration * self.dt
        y = vehicles.y + self.lateral * self.dt
        return vehicles.with_(x=vehicles.x + speed * self.dt, y=y, speed=speed), memory


def drive(traffic, n, m, seconds, visit=lambda vehicles: None):
    """Run traffic with a keep-lane ego, calling ``visit`` after every physics step."""
    env = HighwayEnv(traffic, num_envs=n, vehicles=m)
    env.recorder = lambda vehicles, running: visit(vehicles)
    state = env.reset()
    for _ in range(seconds):
        state["action"] = torch.zeros(n, dtype=torch.int64)
        state = env.step(state)["next"]
    return state


def test_the_mean_wait_of_equation_10_is_the_root_of_half_pi_t_m_and_not_t_m():
    t_m, waits = 2218.0, []
    draws = torch.Generator().manual_seed(0)
    clock, waiting = torch.zeros(20_000), torch.ones(20_000, dtype=torch.bool)
    wait = torch.zeros(20_000)
    for _ in range(400):
        starts = torch.rand(20_000, generator=draws) < literal_hazard(clock, t_m)
        wait = torch.where(waiting & starts, clock, wait)
        waiting &= ~starts
        clock += 1
    assert not waiting.any()
    waits = wait.mean().item()
    assert waits == pytest.approx(math.sqrt(math.pi * t_m / 2), rel=0.02)


def test_the_literal_hazard_is_certain_at_t_m():
    assert literal_hazard(torch.tensor([0.0, 1109.0, 2218.0, 9999.0]), 2218.0).tolist() == [0.0, 0.5, 1.0, 1.0]


def test_a_rate_per_kilometre_gives_that_many_changes_per_kilometre():
    speed = torch.tensor([10.0, 20.0])
    per_step = distance_hazard(speed, 0.92, 0.1)
    assert (per_step / (speed * 0.1 / 1000)).tolist() == pytest.approx([0.92, 0.92], rel=1e-2)


def test_a_side_always_has_a_lane_on_it():
    u = torch.rand(1000, generator=torch.Generator().manual_seed(1))
    for lane, sides in ((0, {1}), (1, {-1, 1}), (2, {-1})):
        assert set(random_side(u, torch.full((1000,), lane), 3).tolist()) == sides
    assert set(random_side(u, torch.zeros(1000, dtype=torch.int64), 1).tolist()) == {0}


def test_literal_changes_end_on_a_lane_centre_at_their_own_lateral_speed_and_restart_the_clock():
    changes = LiteralChanges(mean_steps=60.0, lateral_speed_mps=1.0, lateral_speed_sd_mps=0.0)
    overlay = LiteralLaneChange(changes=changes)
    lateral, before = [], {}

    def visit(vehicles):
        if before:
            lateral.append((vehicles.y - before["y"])[:, 1:])
        before["y"] = vehicles.y

    state = drive(TrafficSequential({"base": IdmTraffic(), "change": overlay}), 16, 6, 40, visit)
    moved = torch.cat(lateral)
    fast = moved[moved.abs() > 0.05].abs()
    assert len(fast) > 1000
    assert fast.max() <= 0.1 + 1e-3
    memory = state["traffic", "change"]
    settled = (memory["lateral_speed"] == 0)[:, 1:]
    offset = (state["vehicles", "y"] - state["vehicles", "target_lane"] * 4.0).abs()[:, 1:]
    assert offset[settled & (memory["clock"][:, 1:] == 0)].max() < 1e-3
    assert (memory["clock"][:, 1:][~settled] == 0).all()


def test_literal_changes_come_many_times_too_often():
    count, before, km = [0], {}, [0.0]

    def visit(vehicles):
        if before:
            count[0] += int((vehicles.target_lane != before["lane"])[:, 1:].sum())
        before["lane"] = vehicles.target_lane
        km[0] += float(vehicles.speed[:, 1:].sum()) * 1e-4

    drive(TrafficSequential({"base": IdmTraffic(), "change": LiteralLaneChange()}), 32, 9, 60, visit)
    assert count[0] / km[0] > 3.0  # recorded: 0.92 per vehicle-km; equation 9: 0.34


def test_calibrated_changes_find_gaps_and_touch_nobody():
    count, before, overlaps = [0], {}, [0]

    def visit(vehicles):
        if before:
            count[0] += int((vehicles.target_lane != before["lane"])[:, 1:].sum())
        before["lane"] = vehicles.target_lane
        overlaps[0] += int(pair_overlaps(vehicles)[:, 1:, 1:].sum())

    drive(TrafficSequential({"base": IdmTraffic(), "change": CalibratedLaneChange()}), 32, 12, 60, visit)
    assert count[0] > 50
    assert overlaps[0] == 0


def test_sudden_accelerations_fill_a_third_of_the_time_with_the_spread_of_the_data():
    # 2 s of waiting and 1 s of acceleration, in turn.
    overlay = AccelerationOverlay(sudden=SuddenAccelerations(every_s=2.0, lasts_s=1.0, mean=0.0, sd=0.8))
    vehicles = HighwayEnv(IdmTraffic(), num_envs=200).reset()["vehicles"].clone()
    vehicles["speed"][:] = 20.0
    view = TensorDict({"vehicles": vehicles, "moved": vehicles.clone()}, [200])
    view["seed"], view["episode"] = torch.zeros(200, dtype=torch.int64), torch.arange(200)
    view["traffic"] = overlay.init_memory(Vehicles.of(vehicles), view["episode"])
    record = []
    for step in range(300):
        view["step"], view["moved"] = torch.full((200,), step), vehicles.clone()
        record.append(overlay(view)["moved", "acceleration"])
    acceleration = torch.stack(record)
    active = acceleration.abs() > 1e-4
    assert active.float().mean().item() == pytest.approx(1 / 3, abs=0.02)
    assert acceleration[active].std().item() == pytest.approx(0.8, rel=0.05)
    onsets = active[1:] & ~active[:-1]
    assert (active[1:].sum() / onsets.sum()).item() == pytest.approx(10.0, abs=0.6)


def test_the_guard_keeps_a_drifting_network_on_the_road_and_at_a_speed_people_drive():
    worst = []
    road = Road()

    def visit(vehicles):
        half = lateral_half_extent(vehicles)
        outside = torch.maximum(vehicles.y + half - road.left_edge_m(), road.right_edge_m() - (vehicles.y - half))
        worst.append(outside[:, 1:].max())

    state = drive(TrafficSequential({"base": Drift(road), "guard": Guard(road)}), 16, 9, 90, visit)
    assert max(worst) <= 1e-4
    vehicles = state["vehicles"]
    assert (vehicles["speed"] <= vehicles["desired_speed"] + 0.1).all()
    assert pair_overlaps(Vehicles.of(vehicles)).sum() == 0


def test_the_guard_does_not_let_a_network_that_always_brakes_stand_still():
    traffic = TrafficSequential({"base": Drift(lateral=0.0, acceleration=-3.0), "guard": Guard()})
    state = drive(traffic, 8, 3, 120)
    assert state["vehicles", "speed"][:, 1:].min() > 4.0


def test_the_guard_leaves_sensible_driving_alone():
    guard, base = Guard(), IdmTraffic()
    env = HighwayEnv(base, num_envs=8)
    state = env.reset()
    for _ in range(30):
        state["action"] = torch.zeros(8, dtype=torch.int64)
        state = env.step(state)["next"]
    view = base(TensorDict({k: state[k] for k in base.in_keys}, [8]))
    before = Vehicles.of(view["moved"])
    view["traffic"] = TensorDict({}, [8])
    after = Vehicles.of(guard(view)["moved"])
    torch.testing.assert_close(after.x, before.x)
    torch.testing.assert_close(after.y, before.y, atol=1e-3, rtol=0)


def test_a_model_without_memory_drives_through_rollouts_and_resets():
    for traffic in (Drift(lateral=0.0), TrafficSequential({"base": Drift(lateral=0.0), "guard": Guard()})):
        env = HighwayEnv(traffic, num_envs=3, episode=EpisodeParameters(goal_m=60.0))
        rollout = env.rollout(12, break_when_any_done=False)
        assert rollout["next", "done"].any()
        again = env.rollout(3, tensordict=env.reset(), auto_reset=False, break_when_any_done=False)
        assert again.shape == (3, 3)


def test_each_part_of_a_chain_keeps_its_own_memory():
    traffic = TrafficSequential({"base": IdmTraffic(), "change": LiteralLaneChange(), "guard": Guard()})
    spec = traffic.memory_spec(2, 5)
    assert set(spec) == {"base", "change", "guard"}
    state = drive(traffic, 2, 5, 1)
    assert set(state["traffic"].keys()) == {"base", "change", "guard"}
    assert state["traffic", "base", "steering"].shape == (2, 5)
