"""Vehicles that enter a road and leave it."""

import pytest
import torch
from reference.refusals import user_error
from reference.worlds import same_bits, step, vehicles

import ganlane
from ganlane import keys
from ganlane.settings.env import EnvConfig
from ganlane.settings.record import make
from ganlane.settings.road import EXIT, FlowParameters, LaneStretch
from ganlane.sim.flow import let_in_and_out
from ganlane.sim.idm import TABLE_V
from ganlane.sim.state import Road, Vehicles

#: The right lane begins at 50 m and leaves the road at 200 m.
STRETCHES = (LaneStretch(50.0, 200.0, EXIT), LaneStretch())
EGO = {"x": 0.0, "lane": 1}
WAITING = {"x": 400.0, "lane": 1, "valid": False}
#: One vehicle a second in every lane of the road.
FULL = FlowParameters(vph=3600.0, to_m=300.0)


def after(flow: FlowParameters, *others: dict, rows: int = 1, ego: dict = EGO) -> Vehicles:
    """The ``ego`` and the ``others`` after a decision of 1 s, in as many episodes as ``rows``."""
    scene = vehicles(ego, *others).part([0] * rows)
    key = torch.arange(rows) * 7919 + 11
    steps = torch.full_like(key, 10)
    road = Road(2, stretches=STRETCHES, flow=flow)
    return let_in_and_out(scene, road, TABLE_V, key, steps, 1.0)


# Who leaves


@pytest.mark.parametrize(
    ("car", "stays"),
    [
        ({"x": 299.0, "lane": 1}, True),
        ({"x": 301.0, "lane": 1}, False),
        ({"x": 199.0, "lane": 0}, True),
        ({"x": 201.0, "lane": 0}, False),
        ({"x": 201.0, "lane": 1}, True),
    ],
)
def test_who_has_passed_the_end_of_the_section_or_of_the_exit_lane_waits_outside(car, stays):
    flow = FlowParameters(exit_share=0.5, from_m=-300.0, to_m=300.0)
    assert after(flow, car).valid[0].tolist() == [True, stays]


def test_the_ego_never_leaves_by_itself():
    flow = FlowParameters(1.0, to_m=300.0)
    assert after(flow, EGO, ego={"x": 400.0, "lane": 1}).valid.all()


# Who enters


def test_vehicles_arrive_in_each_lane_as_often_as_they_should():
    """Every second with probabilities of 0.3 on the road and 0.1 on the ramp."""
    flow = FlowParameters(vph=1080.0, ramp_vph=360.0, to_m=300.0)
    now = after(flow, WAITING, {**WAITING, "x": 500.0}, rows=20_000)
    came = now.valid[:, 1:]
    lanes = now.target_lane[:, 1:]
    share = [((lanes == lane) & came).sum().item() / 20_000 for lane in (0, 1)]
    assert share == pytest.approx([0.1, 0.3], abs=0.01)
    assert set(now.x[:, 1:][came].tolist()) == {-300.0}
    # Either of the two who wait is as likely.
    first, second = came.sum(0).tolist()
    assert first == pytest.approx(second, rel=0.1)


@pytest.mark.parametrize(
    ("other", "room"),
    [
        ({"x": -290.0}, False),
        ({"x": -290.0, "lane": 0}, True),
        ({"x": -250.0}, True),
        ({"x": -250.0, "speed": 0.0}, False),
        ({"x": -310.0}, False),
        ({"x": -330.0, "speed": 35.0}, False),
        ({"x": -290.0, "y": 1.5, "target_lane": 1}, False),
    ],
)
def test_one_for_whom_there_is_no_room_is_turned_away(other, room):
    assert bool(after(FULL, WAITING, {"lane": 1, **other}).valid[0, 1]) == room
    # And so is one in the middle of a change.
    assert not after(FULL, {**WAITING, "y": 4.5}, {"lane": 1, **other}).valid[0, 1]


def test_as_many_leave_by_the_exit_as_should_also_of_those_who_enter():
    flow = FlowParameters(vph=3600.0, exit_share=0.3, to_m=300.0)
    exits = flow.exits(101)
    assert sum(exits[1:]) == 30
    assert exits[0], "the exit is the ego's mission"
    slots = [{**WAITING, "x": 400.0 + slot} for slot in range(20)]
    came = after(flow, *slots, rows=20_000).valid
    came[:, 0] = False
    assert came.sum() == 20_000
    share = came[:, torch.tensor(flow.exits(21))].sum() / 20_000
    assert share.item() == pytest.approx(0.3, abs=0.01)


# In scenarios


def test_most_of_those_who_are_to_leave_by_the_exit_do_and_few_others():
    flow = {"vph": 700.0, "ramp_vph": 500.0, "exit_share": 0.3, "slots": 40}
    env = ganlane.make_env("idm_mobil", 16, env="weave", flow=flow).base_env
    exits = torch.tensor(env.road.flow.exits(env.vehicles))
    td = env.reset()
    # Nobody meets the ego, and it ends nothing.
    td[keys.VEHICLES, "x"][:, keys.EGO_INDEX] = -1e6
    td[keys.VEHICLES, "valid"][:, keys.EGO_INDEX] = False
    # Who left, by whether they were to take the exit and whether they did.
    left = torch.zeros(4)
    for _ in range(150):
        after = step(env, td)
        gone = td[keys.VEHICLES, "valid"] & ~after[keys.VEHICLES, "valid"]
        by_exit = td[keys.VEHICLES, "y"] < 2.0
        left += torch.bincount((2 * exits + by_exit)[gone], minlength=4)
        td = after
    went_on, went_wrong, missed, took_it = left.tolist()
    assert took_it > 0.8 * (took_it + missed) > 80
    assert went_wrong < 0.2 * (went_on + went_wrong)


# What is refused


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"name": "highway", "flow": {"vph": 100.0}}, "take env=merge"),
        ({"name": "merge", "recycle": True, "flow": {"vph": 100.0}}, "nobody returns"),
        ({"name": "merge", "flow": {"vph": 3700.0}}, "flow.vph=3700: expected at most 3600"),
        ({"name": "merge", "flow": {"exit_share": 0.1}}, "the road has no exit"),
        ({"name": "merge", "flow": {"vph": 9.0, "to_m": 300.0}}, "to above 350 m"),
        ({"name": "merge", "flow": {"vph": 9.0, "from_m": 1.0}}, "from below 0 m"),
        ({"name": "merge", "flow": {"vph": -1.0}}, "at least 0"),
    ],
)
def test_a_flow_that_cannot_be_is_refused_in_one_sentence(changes, sentence):
    with user_error(sentence):
        make(EnvConfig, changes)


def test_a_flow_on_a_road_without_ends_is_refused():
    with user_error("needs a road whose lanes end"):
        Road(flow=FlowParameters(vph=100.0))


def test_without_a_flow_a_scenario_is_what_it_was():
    envs = [
        ganlane.make_env("idm", 4, env="merge", flow=flow).base_env
        for flow in ({}, {"slots": 5, "to_m": 900.0})
    ]
    plain, off = (step(env, env.reset()) for env in envs)
    assert same_bits(plain, off) == []
    assert plain[keys.VEHICLES, "valid"].shape == (4, 21)
    assert plain[keys.VEHICLES, "valid"].all()
