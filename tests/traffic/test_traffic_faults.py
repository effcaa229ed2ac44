"""Drivers' faults: as often as asked for, and doing what they say; none of them, and nothing changes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from reference.worlds import DOUBLE, environment, same_bits, step, vehicles
from scipy.stats import binomtest

from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.errors import UserError
from ganlane.parameters.driving import DriverFaults
from ganlane.sim import Road, SpawnParameters, Vehicles, pair_overlaps, perceive
from ganlane.traffic import (
    AbortedLaneChange,
    AbortFaults,
    BrakingFaults,
    CalibratedChanges,
    CalibratedLaneChange,
    HesitantLaneChange,
    HesitationFaults,
    IdmMobilTraffic,
    IdmTraffic,
    LateReaction,
    LiteralChanges,
    LiteralLaneChange,
    Overlay,
    PhantomBraking,
    ReactionFaults,
    TrafficModule,
    TrafficSequential,
)
from ganlane.traffic.faults import driven_at
from ganlane.traffic.presets import gan_calibrated_traffic, gan_traffic, idm_faults_traffic, with_faults

NONE = DriverFaults(BrakingFaults(0.0), ReactionFaults(0.0), HesitationFaults(0.0), AbortFaults(0.0))
EGO = {"x": -1000.0, "lane": 0}


class OneChange(IdmTraffic):
    """Everybody changes to the left once, after a second; a driver who turns back does not try again."""

    def move(self, vehicles, memory, key, step):
        target = vehicles.target_lane
        changed = torch.where((step == 10)[:, None], target + 1, target)
        return self.drive(perceive(vehicles, self.road), changed, memory)


class SuddenLeader(Overlay):
    """Vehicle 1 drives at a steady speed and brakes (if at all) from second 3 to 5."""

    def __init__(self, brakes):
        super().__init__()
        self.brakes = brakes

    def rewrite(self, vehicles, moved, memory, key, step):
        brakes = (step >= 30) & (step < 50) & self.brakes
        leader = driven_at(vehicles, moved, torch.where(brakes, -3.0, 0.0)[:, None].expand_as(moved.x), self.dt)
        return leader.where(torch.arange(vehicles.x.shape[1])[None] == 1, moved), memory


def play(traffic: TrafficModule, scene: Vehicles, steps: int) -> list[Vehicles]:
    """The scene after each physics step; the ego is one of the traffic."""
    rows = scene.x.shape[0]
    td = environment(num_envs=rows, vehicles=scene.x.shape[1], traffic=traffic).reset()
    td[keys.VEHICLES].update(scene.as_dict())
    seen = []
    for number in range(steps):
        td[keys.STEP] = torch.full((rows,), number)
        traffic(td)
        td[keys.VEHICLES] = td.pop(keys.MOVED)
        seen.append(Vehicles.of(td[keys.VEHICLES].clone()))
    return seen


def in_simulation(traffic: TrafficModule, rows: int, seconds: int, part: str, field: str, **others):
    """Memory (before, after) and vehicles (before, after) of every physics step, the ego left out."""
    env = environment(num_envs=rows, traffic=traffic, period_s=0.1, dtype=torch.float32, **others)
    td = env.reset()
    for _ in range(seconds * 10):
        after = step(env, td)
        memories = (state[keys.TRAFFIC, part, field][:, 1:] for state in (td, after))
        yield (*memories, *(Vehicles.of(state[keys.VEHICLES]).columns(slice(1, None)) for state in (td, after)))
        td = after


def assert_share(count: int, trials: int, share: float) -> None:
    """The exact binomial interval (99.9 %) of what was counted holds the share asked for."""
    interval = binomtest(count, trials).proportion_ci(0.999, "exact")
    assert interval.low <= share <= interval.high, (count, trials, share)


def test_phantom_braking_comes_as_often_as_asked_for():
    faults = replace(NONE, phantom_braking=BrakingFaults(per_hour=300.0, lasts_s=1.0))
    begun = driven = 0
    for before, after, _, _ in in_simulation(idm_faults_traffic(faults=faults), 32, 60, "phantom_braking", "left"):
        begun += ((before == 0) & (after == 9)).sum().item()
        driven += (before == 0).sum().item()
    assert begun > 500
    # A constant hazard: 1 - exp(-rate dt) per step of 0.1 s.
    assert_share(begun, driven, 1.0 - torch.tensor(-300.0 / 36_000.0, dtype=DOUBLE).exp().item())


def test_attention_lapses_as_often_as_asked_for():
    faults = replace(NONE, late_reaction=ReactionFaults(per_hour=300.0, lasts_s=2.0))
    begun = driven = 0
    for before, after, _, _ in in_simulation(idm_faults_traffic(faults=faults), 32, 60, "late_reaction", "left"):
        begun += ((before == 0) & (after == 19)).sum().item()
        driven += (before == 0).sum().item()
    assert begun > 400
    assert_share(begun, driven, 1.0 - torch.tensor(-300.0 / 36_000.0, dtype=DOUBLE).exp().item())


def busy(part: str, overlay: TrafficModule) -> TrafficSequential:
    """Traffic that changes lanes all the time, with one fault."""
    changes = CalibratedLaneChange(changes=CalibratedChanges(per_km=10.0))
    return TrafficSequential({"base": IdmTraffic(), "change": changes, part: overlay})


def test_the_share_of_changes_asked_for_is_hesitant():
    hesitant = started = 0
    traffic = busy("fault", HesitantLaneChange(faults=HesitationFaults(share=0.3)))
    for _, after, was, now in in_simulation(traffic, 48, 60, "fault", "hesitant"):
        starts = was.target_lane != now.target_lane
        started += starts.sum().item()
        hesitant += (after & starts).sum().item()
    assert started > 400
    assert_share(hesitant, started, 0.3)


def test_the_share_of_changes_asked_for_is_broken_off():
    turned = started = 0
    traffic = busy("fault", AbortedLaneChange(faults=AbortFaults(share=0.3)))
    for before, after, was, now in in_simulation(traffic, 48, 60, "fault", "origin"):
        moves = was.target_lane != now.target_lane
        turns = moves & (before >= 0) & (after < 0) & (now.target_lane == before)
        turned += turns.sum().item()
        started += (moves & ~turns).sum().item()
    assert started > 400
    # Some changes are under way when the run ends.
    assert_share(turned, started, 0.3)


@pytest.mark.parametrize("mobil", [True, False])
def test_with_everything_off_the_base_is_left_bitwise_as_it_is(mobil):
    def base():
        return IdmMobilTraffic() if mobil else IdmTraffic()

    plain = environment(num_envs=16, traffic=base())
    faulty = environment(num_envs=16, traffic=with_faults(base(), NONE))
    one, other = plain.reset(), faulty.reset()
    for decision in range(40):
        action = torch.full((16,), decision % 7 % 3)
        one, other = step(plain, one, action), step(faulty, other, action)
        assert same_bits(one.exclude(keys.TRAFFIC), other.exclude(keys.TRAFFIC)) == []
        assert same_bits(one[keys.TRAFFIC], other[keys.TRAFFIC, "base"]) == []


OFTEN = DriverFaults(
    BrakingFaults(per_hour=600.0), ReactionFaults(per_hour=600.0), HesitationFaults(0.5), AbortFaults(0.5)
)


def episodes(rows: int, first: int, decisions: int) -> list:
    env = environment(num_envs=rows, traffic=idm_faults_traffic(faults=OFTEN), dtype=torch.float32)
    asked = env.reset().select(keys.SEED, keys.EPISODE)
    asked[keys.EPISODE] = first + torch.arange(rows)
    td, seen = env.reset(asked), []
    for _ in range(decisions):
        td = step(env, td, (td[keys.EPISODE] + td[keys.EGO, "decisions"]) % 5 % 3)
        seen.append(td)
    return seen


@pytest.mark.parametrize(("rows", "first"), [pytest.param(1, 0, marks=pytest.mark.slow), (1, 40), (7, 20)])
def test_an_episode_with_faults_is_the_same_bits_at_every_batch_size(rows, first):
    wide, narrow = episodes(64, 0, 20), episodes(rows, first, 20)
    faulty = wide[-1][keys.TRAFFIC]
    assert (faulty["phantom_braking", "left"] > 0).any()
    assert (faulty["late_reaction", "left"] > 0).any()
    for all_rows, some in zip(wide, narrow):
        assert same_bits(all_rows[first : first + rows], some) == []


def test_an_aborted_change_returns_to_the_centre_of_the_lane_it_left():
    scene = vehicles(EGO, {"x": 0.0, "lane": 1}, {"x": 100.0, "lane": 0, "speed": 10.0})
    traffic = TrafficSequential({"base": OneChange(), "fault": AbortedLaneChange(faults=AbortFaults(1.0))})
    track = play(traffic, scene, 160)
    way = torch.stack([now.y[0] for now in track])[:, 1:] - torch.tensor([4.0, 0.0], dtype=DOUBLE)
    # It comes half way over, not so far that it leaves its old lane, and settles where it was.
    assert (way.amax(0) >= 2.0).all()
    assert (way.amax(0) < 3.0).all()
    assert (way[-30:].abs() < 0.05).all()
    assert track[-1].target_lane[0, 1:].tolist() == [1, 0]
    other = play(
        TrafficSequential({"base": OneChange(), "fault": AbortedLaneChange(faults=AbortFaults(0.0))}), scene, 160
    )
    assert other[-1].target_lane[0, 1:].tolist() == [2, 1]


def test_a_literal_change_that_is_broken_off_goes_back_as_fast_as_it_came():
    scene = vehicles(*({"x": 150.0 * i, "lane": lane} for i, lane in enumerate((0, 0, 1, 2, 1, 0))))
    # Everybody begins a change within ten steps, and another one within ten steps after it.
    changes = LiteralChanges(mean_steps=10.0, lateral_speed_mps=0.8, lateral_speed_sd_mps=0.0)
    parts = {"base": IdmTraffic(), "change": LiteralLaneChange(changes=changes)}
    track = play(TrafficSequential({**parts, "fault": AbortedLaneChange(faults=AbortFaults(1.0))}), scene, 90)
    y = torch.stack([scene.y[0], *(now.y[0] for now in track)])[:, 1:]
    assert y.diff(dim=0).abs().max() < 0.09
    reached = (y - y[0]).abs().amax(0)
    assert (reached >= 2.0).all()
    assert (reached < 2.2).all()


def test_a_broken_off_change_of_the_papers_traffic_does_not_jump_either():
    traffic = TrafficSequential({"base": gan_traffic(), "fault": AbortedLaneChange(faults=AbortFaults(1.0))})
    widest = turned = 0.0
    for before, after, was, now in in_simulation(traffic, 8, 20, "fault", "origin"):
        turned += ((before >= 0) & (after < 0) & (now.target_lane == before)).sum().item()
        # Rows of new episodes start elsewhere.
        same = (now.x >= was.x).all(1) & (now.x - was.x < 10.0).all(1)
        widest = max(widest, (now.y - was.y)[same].abs().amax().item())
    assert turned > 30
    # The guard's pull is added to the driver's own pace, which is seldom above 2 m/s.
    assert widest < 0.4


def test_a_hesitant_change_takes_about_twice_as_long_and_does_not_swing():
    scene = vehicles(
        EGO, *({"x": 200.0 * i, "speed": v, "desired_speed": v} for i, v in enumerate((8.0, 15.0, 30.0)))
    )
    took = []
    for share in (0.0, 1.0):
        overlay = HesitantLaneChange(faults=HesitationFaults(share, pace=0.5))
        track = play(TrafficSequential({"base": OneChange(), "fault": overlay}), scene, 200)
        offset = torch.stack([now.y[0] for now in track])[:, 1:] - 4.0
        took.append((offset.abs() > 0.3).sum(0) - 10)
        assert (offset < 0.3).all()
        assert (offset[-1].abs() < 0.05).all()
    ratio = took[1] / took[0]
    assert ((ratio > 1.5) & (ratio < 2.5)).all(), ratio


def test_a_late_driver_reacts_later_by_the_delay():
    scene = vehicles(EGO, {"x": 60.0, "speed": 20.0}, {"x": 0.0, "speed": 20.0})
    always = ReactionFaults(per_hour=1e9, delay_s=0.8, lasts_s=60.0)
    eased = {}
    for late in (False, True):
        overlay = LateReaction(faults=always if late else replace(always, per_hour=0.0))
        with_brake, without = (
            play(
                TrafficSequential({"base": IdmTraffic(), "late": overlay, "leader": SuddenLeader(brakes)}), scene, 60
            )
            for brakes in (True, False)
        )
        eased[late] = [
            one.acceleration[0, 2] < two.acceleration[0, 2] for one, two in zip(with_brake, without)
        ].index(True)
    assert eased[False] == 31  # the leader is slower from the end of step 30 on
    assert eased[True] - eased[False] == 8


def test_a_late_driver_drives_what_he_should_have_driven_before():
    """Open loop: a base that ignores its own speed, so that late driving does not change what it decides."""

    class Wave(TrafficModule):
        def move(self, vehicles, memory, key, step):
            pace = torch.sin(0.3 * step.to(vehicles.x.dtype))[:, None].expand_as(vehicles.x)
            return driven_at(vehicles, vehicles, pace, self.dt), memory

    scene = vehicles(EGO, {"x": 60.0, "speed": 20.0})
    always = ReactionFaults(per_hour=1e9, delay_s=0.5, lasts_s=60.0)
    prompt = play(Wave(), scene, 50)
    late = play(TrafficSequential({"base": Wave(), "late": LateReaction(faults=always)}), scene, 50)
    for now, before in zip(late[5:], prompt):
        torch.testing.assert_close(now.acceleration[:, 1], before.acceleration[:, 1])
    assert [round(now.acceleration[0, 1].item(), 9) for now in late[:5]] == [0.0] * 5


def test_a_phantom_braker_loses_the_speed_it_says_and_goes_on_as_before():
    scene = vehicles(EGO, {"x": 0.0, "speed": 25.0}, {"x": 4000.0, "speed": 3.0})
    once = BrakingFaults(per_hour=1e9, deceleration=4.0, lasts_s=1.0)
    overlay = PhantomBraking(faults=once)
    track = play(TrafficSequential({"base": IdmTraffic(), "fault": overlay}), scene, 10)
    speed = torch.stack([now.speed[0, 1:] for now in track])
    assert speed[:, 0].tolist() == pytest.approx([25.0 - 0.4 * (k + 1) for k in range(10)])
    assert (track[-1].x[0, 1] - scene.x[0, 1]).item() == pytest.approx(25.0 - 0.5 * 4.0)
    # A slow one stops and does not roll back.
    assert speed[:, 1].min() == 0.0
    assert (track[-1].x[0, 2] - scene.x[0, 2]).item() == pytest.approx(3.0**2 / 8.0, abs=0.05)


def test_a_driver_who_brakes_harder_anyway_goes_on_doing_so():
    scene = vehicles(EGO, {"x": 0.0, "speed": 25.0}, {"x": 20.0, "speed": 5.0})
    overlay = PhantomBraking(faults=BrakingFaults(per_hour=1e9))
    faulty = play(TrafficSequential({"base": IdmTraffic(), "fault": overlay}), scene, 1)[0]
    plain = play(IdmTraffic(), scene, 1)[0]
    assert plain.acceleration[0, 1] < -4.0
    assert faulty.acceleration[0, 1] == plain.acceleration[0, 1]


def test_faults_come_to_nobody_who_is_not_there_and_never_to_the_ego():
    scene = vehicles(EGO, {"x": 0.0, "valid": False}, {"x": 100.0})
    always = DriverFaults(BrakingFaults(1e9), ReactionFaults(1e9), HesitationFaults(1.0), AbortFaults(1.0))
    traffic = with_faults(OneChange(), always)
    td = environment(num_envs=1, vehicles=3, traffic=traffic).reset()
    td[keys.VEHICLES].update(scene.as_dict())
    td[keys.STEP] = torch.tensor([10])
    traffic(td)
    memory = td[keys.TRAFFIC]
    for part in ("phantom_braking", "late_reaction"):
        assert (memory[part, "left"][0] > 0).tolist() == [False, False, True]
    assert memory["hesitant_change", "hesitant"][0].tolist() == [False, False, True]
    assert (memory["aborted_change", "origin"][0] >= 0).tolist() == [False, False, True]


@given(
    speed=st.floats(0.0, 40.0),
    usual=st.floats(-8.0, 3.0),
    wanted=st.floats(-8.0, 3.0),
    heading=st.floats(-0.2, 0.2),
)
def test_driving_a_path_at_another_speed_stays_on_it_and_never_goes_back(speed, usual, wanted, heading):
    start = vehicles({"x": 10.0, "y": 1.0, "speed": speed, "heading": heading, "target_lane": 0})
    gone = 0.5 * (speed + max(speed + usual * 0.1, 0.0)) * 0.1
    angle = torch.tensor(heading, dtype=DOUBLE)
    moved = start.with_(
        x=start.x + gone * torch.cos(angle),
        y=start.y + gone * torch.sin(angle),
        speed=(start.speed + usual * 0.1).clamp_min(0.0),
    )
    other = driven_at(start, moved, torch.full_like(start.x, wanted), 0.1)
    dx, dy = (other.x - start.x).item(), (other.y - start.y).item()
    distance = 0.5 * (speed + max(speed + wanted * 0.1, 0.0)) * 0.1
    assert other.speed.item() == pytest.approx(max(speed + wanted * 0.1, 0.0))
    assert (dx * dx + dy * dy) ** 0.5 == pytest.approx(distance, abs=1e-9)
    assert dx >= 0.0
    assert dy * dx == pytest.approx(dx * dx * torch.tan(angle).item(), abs=1e-6)


def test_a_delay_shorter_than_a_step_is_refused():
    with pytest.raises(UserError, match=r"delay_s=0\.01: expected at least 0\.1"):
        LateReaction(faults=ReactionFaults(delay_s=0.01))


def overlaps_in(traffic: TrafficModule, vehicle_km: float, rows: int, seconds: int) -> int:
    """Steps with overlapping others in ``vehicle_km`` of their driving, 13 to a row, in episodes of ``seconds``."""
    env = HighwayEnv(traffic, rows, 14, SpawnParameters(spread_m=300.0))
    km, overlaps = 0.0, 0

    def record(now: Vehicles, running: torch.Tensor) -> None:
        nonlocal km, overlaps
        km += (now.speed * running[:, None])[:, 1:].sum().item() * 1e-4
        overlaps += pair_overlaps(now)[:, 1:, 1:].sum().item() // 2

    env.recorder = record
    td, number = env.reset(), 0
    while km < vehicle_km:
        td = step(env, td)
        number += 1
        if number % seconds == 0:
            td[keys.EPISODE] = td[keys.EPISODE] + rows
            td = env.reset(td.select(keys.SEED, keys.EPISODE))
    return overlaps


def test_faults_ten_times_as_frequent_make_no_overlaps_in_100_vehicle_km():
    often = DriverFaults(BrakingFaults(60.0), ReactionFaults(120.0), HesitationFaults(0.5), AbortFaults(0.5))
    assert overlaps_in(idm_faults_traffic(Road(), 2, faults=often), 100.0, 24, 60) == 0


@pytest.mark.slow
def test_faults_as_they_are_by_default_make_no_overlaps_in_5000_vehicle_km():
    assert overlaps_in(idm_faults_traffic(Road(), 2), 5000.0, 128, 100) == 0


def test_faults_lie_over_generated_traffic_too():
    # Ten times the default rates; at a hundred times (OFTEN) generated drivers, who keep less distance, do overlap.
    often = DriverFaults(BrakingFaults(60.0), ReactionFaults(120.0), HesitationFaults(0.5), AbortFaults(0.5))
    env = HighwayEnv(with_faults(gan_calibrated_traffic(), often), 16)
    td, overlaps, braked = env.reset(), 0, 0
    for _ in range(20):
        td = step(env, td)
        overlaps += pair_overlaps(Vehicles.of(td[keys.VEHICLES]))[:, 1:, 1:].sum().item()
        braked += (td[keys.TRAFFIC, "phantom_braking", "left"] > 0).sum().item()
    assert overlaps == 0
    assert braked > 0
    memory = td[keys.TRAFFIC]
    assert memory["base", "generator", "noise"].isfinite().all()
    assert (td[keys.VEHICLES, "y"] > -2.0).all()
    assert (td[keys.VEHICLES, "y"] < 10.0).all()
