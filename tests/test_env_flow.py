"""Vehicles that enter a road and leave it."""

from __future__ import annotations

import pytest
import torch
from reference.worlds import environment, placed, same_bits, step, vehicles

import ganlane
from ganlane import keys
from ganlane.build import make_highways
from ganlane.env import HighwayEnv
from ganlane.errors import ParameterError, UserError
from ganlane.gym.native_rows import native_rows
from ganlane.settings.commands import highways
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


def after(flow: FlowParameters, *others: dict, rows: int = 1, step_count: int = 10) -> Vehicles:
    """The ego at 0 and the ``others`` after a decision of 1 s, in as many episodes as ``rows``."""
    scene = Vehicles(*(field.expand(rows, -1) for field in vehicles(EGO, *others)))
    key = torch.arange(rows) * 7919 + 11
    steps = torch.full_like(key, step_count)
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
    scene = vehicles({"x": 400.0, "lane": 1}, {"x": 0.0, "lane": 1})
    road = Road(2, stretches=STRETCHES, flow=FlowParameters(1.0, to_m=300.0))
    ten = torch.tensor([10])
    assert let_in_and_out(scene, road, TABLE_V, ten, ten, 1.0).valid.all()


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


def test_it_keeps_its_speed_and_its_place_in_the_lane():
    flow = FlowParameters(ramp_vph=3600.0, to_m=300.0)
    now = after(flow, {**WAITING, "y": 4.2, "heading": 0.01, "speed": 17.0})
    assert now.valid[0, 1]
    assert now.y[0, 1].item() == pytest.approx(0.2)
    assert (now.speed[0, 1], now.heading[0, 1]) == (17.0, 0.01)


def test_who_is_in_the_middle_of_a_change_goes_on_waiting():
    flow = FlowParameters(vph=3600.0, to_m=300.0)
    assert not after(flow, {**WAITING, "y": 4.5}).valid[0, 1]


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
    flow = FlowParameters(vph=3600.0, to_m=300.0)
    assert bool(after(flow, WAITING, {"lane": 1, **other}).valid[0, 1]) == room


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


def scenario(
    name: str, traffic: str, rows: int, kernel: str = "native", **flow: float
) -> HighwayEnv:
    """With a goal and a time limit far away."""
    far = {"goal_m": 1e5, "timeout_s": 1e4}
    return ganlane.make_env(traffic, rows, env=name, kernel=kernel, flow=flow, **far).base_env


def test_most_of_those_who_are_to_leave_by_the_exit_do_and_few_others():
    flow = {"vph": 700.0, "ramp_vph": 500.0, "exit_share": 0.3, "slots": 40}
    env = scenario("weave", "idm_mobil", 16, **flow)
    exits = torch.tensor(env.road.flow.exits(env.vehicles))
    td = env.reset()
    # Nobody meets the ego, and it ends nothing.
    td[keys.VEHICLES, "x"][:, keys.EGO_INDEX] = -1e6
    td[keys.VEHICLES, "valid"][:, keys.EGO_INDEX] = False
    left = {True: torch.zeros(2), False: torch.zeros(2)}
    for _ in range(150):
        after = step(env, td)
        gone = td[keys.VEHICLES, "valid"] & ~after[keys.VEHICLES, "valid"]
        td = after
        by_exit = td[keys.VEHICLES, "y"] < 2.0
        for kind in left:
            those = gone & (exits == kind)
            left[kind] += torch.tensor([(those & by_exit).sum(), (those & ~by_exit).sum()])
    assert left[True][0] > 0.8 * left[True].sum()
    assert left[False][0] < 0.2 * left[False].sum()
    assert left[True].sum() > 100


@pytest.mark.parametrize(("name", "exit_share"), [("merge", 0.0), ("weave", 0.3)])
def test_gymnasium_drives_them_like_torchrl(name, exit_share):
    """Bit for bit, through the starts of further episodes."""
    flow = {"vph": 1200.0, "ramp_vph": 600.0, "exit_share": exit_share, "slots": 20}
    config = highways(env=name, kernel="native", timeout_s=20.0, flow=flow, num_envs=5)
    rows = native_rows(config)
    assert rows is not None
    env = make_highways(config)
    td = env.reset()
    rows.start(0, td[keys.EPISODE].numpy())
    for _ in range(25):
        for field in keys.VEHICLE_FIELDS:
            theirs = rows.batch.state[keys.VEHICLES, field]
            assert torch.equal(td[keys.VEHICLES, field], torch.from_numpy(theirs)), field
        td["action"] = torch.zeros(5, dtype=torch.int64)
        stepped, td = env.step_and_maybe_reset(td)
        rows.step(stepped["action"].numpy())
        done = stepped["next", "done"][:, 0].numpy()
        if done.any():
            rows.restart(done)


def test_a_recorder_sees_the_steps_of_the_tensor_code():
    def seen(kernel: str) -> list[Vehicles]:
        env = scenario("on_ramp", "idm", 3, kernel, vph=1500.0, ramp_vph=600.0)
        frames = []
        env.recorder = lambda cars, running: frames.append(cars)
        td = env.reset()
        for _ in range(8):
            td = step(env, td)
        return frames

    frames = list(zip(seen("native"), seen("torch")))
    assert len(frames) == 80
    for one, other in frames:
        assert torch.equal(one.valid, other.valid)
        assert torch.allclose(one.x, other.x, atol=2e-2)


def test_rows_that_have_ended_stay_as_they_are():
    flow = FlowParameters(vph=3600.0, from_m=-300.0, to_m=300.0)
    states = []
    for kernel in ("torch", "native"):
        env = environment(
            lanes=2, num_envs=2, vehicles=3, stretches=STRETCHES, flow=flow, kernel=kernel,
            dtype=torch.float32,
        )  # fmt: skip
        cars = vehicles(
            {"x": 195.0, "lane": 1}, WAITING, {"x": 310.0, "lane": 1}, dtype=torch.float32
        )
        both = Vehicles(*(field.repeat(2, 1) for field in cars))
        both.x[1, 0] = 100.0
        states.append(step(env, placed(env, both)))
    for state in states:
        assert state["done"][:, 0].tolist() == [True, False]
        valid = state[keys.VEHICLES, "valid"]
        assert valid[0].tolist() == [True, False, True]
        # One of the other two has entered.
        assert valid[1].sum() == 2
        assert (state[keys.VEHICLES, "x"][1] == -300.0).sum() == 1
        assert not (state[keys.VEHICLES, "x"][0] == -300.0).any()


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
    with pytest.raises(ParameterError, match=sentence):
        make(EnvConfig, changes)


def test_a_flow_on_a_road_without_ends_is_refused():
    with pytest.raises(UserError, match="needs a road whose lanes end"):
        Road(flow=FlowParameters(vph=100.0))


def test_without_a_flow_a_scenario_is_what_it_was():
    plain, off = (
        ganlane.make_env("idm", 4, env="merge", flow=flow).base_env
        for flow in ({}, {"slots": 5, "to_m": 900.0})
    )
    assert off.vehicles == plain.vehicles == 21
    after = step(plain, plain.reset())
    assert same_bits(after, step(off, off.reset())) == []
    assert after[keys.VEHICLES, "valid"].all()
