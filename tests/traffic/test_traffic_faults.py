"""Drivers' faults: as often as asked for, and doing what they say.

None of them, and nothing changes.
"""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from reference.refusals import user_error
from reference.traffics import all_faults
from reference.worlds import (
    course,
    environment,
    episode_keys,
    few_changes,
    film_of,
    moves,
    run,
    same_bits,
    vehicles,
)
from scipy.stats import binomtest

from ganlane import keys
from ganlane.settings.driving import AbortFaults, BrakingFaults, HesitationFaults, ReactionFaults
from ganlane.sim import perceive
from ganlane.sim.spawn import RandomScenes
from ganlane.traffic import (
    AbortedLaneChange,
    CalibratedChanges,
    CalibratedLaneChange,
    HesitantLaneChange,
    IdmMobilTraffic,
    IdmTraffic,
    LateReaction,
    PhantomBraking,
    TrafficModule,
    TrafficSequential,
)
from ganlane.traffic.faults import driven_at
from ganlane.traffic.presets import idm_faults_traffic, with_faults

NONE = all_faults(0.0, 0.0)
EGO = {"x": -1000.0, "lane": 0}


class OneChange(IdmTraffic):
    """Everybody changes to the left once, after a second.

    A driver who turns back does not try again.
    """

    def move(self, vehicles, memory, key, step):
        target = vehicles.target_lane
        changed = torch.where((step == 10)[:, None], target + 1, target)
        return self.drive(perceive(vehicles, self.road), changed, memory, step)


def play(base, scene, steps, **overlays):
    """The one scene after each physics step, [T, M]; the ego is one of the traffic."""
    return film_of(moves(TrafficSequential({"base": base, **overlays}), scene, steps)).at(0)


def in_traffic(traffic, steps, part, field):
    """A field of the memory before and after each physics step of 192 episodes, and target lanes
    before and after; of all but the ego.
    """
    scene = RandomScenes()(episode_keys(range(192)), torch.float32)
    for pair in pairwise(course(traffic, scene, steps)):
        memories = (memory[part, field][:, 1:] for _, memory in pair)
        lanes = (cars.target_lane[:, 1:] for cars, _ in pair)
        yield *memories, *lanes


def assert_share(counts, share, least):
    """The exact binomial interval (99.9 %) of what was counted, in how many cases, holds the share
    asked for; and there were so many at ``least``.
    """
    count, trials = torch.tensor(counts).sum(0).tolist()
    interval = binomtest(count, trials).proportion_ci(0.999, "exact")
    assert interval.low <= share <= interval.high, (count, trials, share)
    assert count > least


@pytest.mark.parametrize(
    ("part", "faults", "at_first", "least"),
    [
        ("phantom_braking", BrakingFaults(per_hour=300.0, lasts_s=1.0), 9, 500),
        ("late_reaction", ReactionFaults(per_hour=300.0, lasts_s=2.0), 19, 400),
    ],
)
def test_a_driver_brakes_for_nothing_or_does_not_attend_as_often_as_asked_for(
    part, faults, at_first, least
):
    traffic = idm_faults_traffic(faults=replace(NONE, **{part: faults}))
    begun = [
        (((before == 0) & (after == at_first)).sum(), (before == 0).sum())
        for before, after, _, _ in in_traffic(traffic, 100, part, "left")
    ]
    # A constant hazard: 1 - exp(-rate dt) per step of 0.1 s.
    assert_share(begun, 1.0 - math.exp(-300.0 / 36_000.0), least)


@pytest.mark.parametrize(
    ("fault", "field"),
    [
        (HesitantLaneChange(faults=HesitationFaults(share=0.3)), "hesitant"),
        # Some changes are under way when the run ends.
        (AbortedLaneChange(faults=AbortFaults(share=0.3)), "origin"),
    ],
)
def test_the_share_of_changes_asked_for_is_hesitant_or_broken_off(fault, field):
    changes = CalibratedLaneChange(changes=CalibratedChanges(per_km=10.0))
    traffic = TrafficSequential({"base": IdmTraffic(), "change": changes, "fault": fault})
    faulty = []
    for before, after, was, now in in_traffic(traffic, 180, "fault", field):
        moves = was != now
        turns = moves & (before >= 0) & (after < 0) & (now == before)
        bad = turns if field == "origin" else after & moves
        faulty.append((bad.sum(), (moves & ~turns).sum()))
    assert_share(faulty, 0.3, least=100)


def test_with_everything_off_the_base_is_left_bitwise_as_it_is():
    plain, faulty = (
        run(environment(num_envs=16, traffic=traffic), 6, few_changes)
        for traffic in (IdmMobilTraffic(), with_faults(IdmMobilTraffic(), NONE))
    )
    for one, other in zip(plain, faulty):
        assert same_bits(one.exclude(keys.TRAFFIC), other.exclude(keys.TRAFFIC)) == []
        assert same_bits(one[keys.TRAFFIC], other[keys.TRAFFIC, "base"]) == []


@pytest.mark.parametrize(("share", "target"), [(1.0, [1, 0]), (0.0, [2, 1])])
def test_an_aborted_change_returns_to_the_centre_of_the_lane_it_left(share, target):
    scene = vehicles(EGO, {"x": 0.0, "lane": 1}, {"x": 100.0, "lane": 0, "speed": 10.0})
    film = play(OneChange(), scene, 120, fault=AbortedLaneChange(faults=AbortFaults(share)))
    assert film.target_lane[-1, 1:].tolist() == target
    if share == 1.0:
        way = film.y[:, 1:] - scene.y[:, 1:]
        # It comes half way over, not so far that it leaves its old lane, and settles where it was.
        assert ((way.amax(0) >= 2.0) & (way.amax(0) < 3.0)).all()
        assert (way[-30:].abs() < 0.05).all()


def test_a_hesitant_change_takes_about_twice_as_long_and_does_not_swing():
    cars = ({"x": 25.0 * v, "speed": v, "desired_speed": v} for v in (8.0, 15.0, 30.0))
    scene = vehicles(EGO, *cars)
    took = []
    for share in (0.0, 1.0):
        fault = HesitantLaneChange(faults=HesitationFaults(share, pace=0.5))
        offset = play(OneChange(), scene, 150, fault=fault).y[:, 1:] - 4.0
        took.append((offset.abs() > 0.3).sum(0) - 10)
        assert (offset < 0.3).all()
        assert (offset[-1].abs() < 0.05).all()
    usual, hesitant = took
    assert ((hesitant > 1.5 * usual) & (hesitant < 2.5 * usual)).all()


def test_a_late_driver_drives_what_he_should_have_driven_before():
    """Open loop.

    A base that ignores its own speed, so that late driving does not change what it decides.
    """

    class Wave(TrafficModule):
        def move(self, vehicles, memory, key, step):
            pace = torch.sin(0.3 * step.to(vehicles.x.dtype))[:, None].expand_as(vehicles.x)
            return driven_at(vehicles, vehicles, pace, self.dt), memory

    scene = vehicles(EGO, {"x": 60.0, "speed": 20.0})
    always = LateReaction(faults=ReactionFaults(per_hour=1e9, delay_s=0.5, lasts_s=60.0))
    prompt = play(Wave(), scene, 50)
    late = play(Wave(), scene, 50, late=always)
    torch.testing.assert_close(late.acceleration[5:, 1], prompt.acceleration[:-5, 1])
    assert (late.acceleration[:5, 1].abs() < 1e-9).all()


def test_a_phantom_braker_loses_the_speed_it_says_and_goes_on_as_before():
    scene = vehicles(EGO, {"x": 0.0, "speed": 25.0}, {"x": 4000.0, "speed": 3.0})
    once = PhantomBraking(faults=BrakingFaults(per_hour=1e9, deceleration=4.0, lasts_s=1.0))
    film = play(IdmTraffic(), scene, 10, fault=once)
    way = film.x[-1] - scene.x[0]
    assert film.speed[:, 1].tolist() == pytest.approx([25.0 - 0.4 * (k + 1) for k in range(10)])
    assert way[1].item() == pytest.approx(25.0 - 0.5 * 4.0)
    # A slow one stops and does not roll back.
    assert film.speed[:, 2].min() == 0.0
    assert way[2].item() == pytest.approx(3.0**2 / 8.0, abs=0.05)


def test_faults_come_to_nobody_who_is_not_there_and_never_to_the_ego():
    scene = vehicles(EGO, {"x": 0.0, "valid": False}, {"x": 100.0})
    traffic = with_faults(OneChange(), all_faults(1e9, 1.0))
    *_, (_, memory) = course(traffic, scene, 11)
    for come in (
        memory["phantom_braking", "left"] > 0,
        memory["late_reaction", "left"] > 0,
        memory["hesitant_change", "hesitant"],
        memory["aborted_change", "origin"] >= 0,
    ):
        assert come.tolist() == [[False, False, True]]


def test_a_delay_shorter_than_a_step_is_refused():
    with user_error(r"delay_s=0\.01: expected at least 0\.1"):
        LateReaction(faults=ReactionFaults(delay_s=0.01))
