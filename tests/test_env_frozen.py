"""What traffic remembers of a row that has ended is what it remembered when the row ended."""

from __future__ import annotations

import pytest
import torch
from reference.worlds import environment, same_bits, step
from tensordict import TensorDict

from ganlane import keys
from ganlane.env.physics import EndedRows, run_decision
from ganlane.parameters.driving import Visibility
from ganlane.traffic import IdmTraffic, Overlay, TrafficModule, TrafficSequential


class Ageing(IdmTraffic):
    """Counts the physics steps that it was asked for."""

    memory_fields = {"age": ((), torch.int64), **IdmTraffic.memory_fields}  # noqa: RUF012

    def fresh_memory(self, vehicles, key):
        return {"age": torch.zeros_like(vehicles.target_lane), **super().fresh_memory(vehicles, key)}

    def move(self, vehicles, memory, key, step):
        moved, kept = super().move(vehicles, {"steering": memory["steering"]}, key, step)
        return moved, {"age": memory["age"] + 1, **kept}


class Forgetful(Overlay):
    """Remembers nothing."""

    def rewrite(self, vehicles, moved, memory, key, step):
        return moved, memory


def ages(traffic: TrafficModule, *name: str) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """After a decision in which rows end at all of its moments: ages, physics steps and who ended, [N]."""
    env = environment(num_envs=64, traffic=traffic, goal_m=100.0, visibility=Visibility.CENTRE)
    td = env.reset()
    to_go = torch.linspace(0.5, 30.0, 64, dtype=torch.float64)
    td[keys.VEHICLES, "x"] = td[keys.VEHICLES, "x"] + (100.0 - to_go)[:, None]
    action = torch.where(torch.arange(64) % 9 == 4, keys.RIGHT, keys.KEEP)
    before = td.clone()
    after = step(env, td, action)
    assert same_bits(td, before) == []
    return after[(keys.TRAFFIC, *name, "age")], after[keys.STEP], after["done"][:, 0]


@pytest.mark.parametrize("chained", [False, True])
def test_an_ended_row_remembers_no_step_more_than_it_was_driven(chained):
    traffic = TrafficSequential({"base": Ageing(), "top": Forgetful()}) if chained else Ageing()
    age, steps, done = ages(traffic, *(["base"] if chained else []))
    assert set(range(11)) <= set(steps.tolist())
    assert done.any()
    assert not done.all()
    assert torch.equal(age, steps[:, None].expand_as(age))


def test_where_a_look_would_stall_the_device_the_memory_is_the_same(monkeypatch):
    """As on a GPU: the rows are kept as they are in every step."""
    looked = ages(Ageing())
    monkeypatch.setattr("ganlane.env.physics.reads_are_cheap", lambda flag: False)
    monkeypatch.setattr(EndedRows, "keep", None)
    for one, other in zip(looked, ages(Ageing())):
        assert torch.equal(one, other)


def test_a_decision_without_steps_leaves_everything_as_it_is():
    env = environment(num_envs=3)
    td = env.reset()
    start, _ = env.physics.begin(
        env.rules,
        torch.tensor([0, 2, 1]),
        env.scenes(torch.arange(3), env.dtype),
        dict(td[keys.EGO].items()),
        td[keys.STEP],
    )
    _, memory = run_decision(env.traffic, env.physics, env.rules, td, start, torch.arange(3), substeps=0)
    assert same_bits(memory, td[keys.TRAFFIC]) == []


def test_a_row_that_never_ran_and_one_that_ended_may_differ_in_empty_parts():
    # Between decisions TorchRL drops parts without a memory, which come back in the first step.
    age = torch.arange(3)
    before = TensorDict({"a": TensorDict({"age": age}, [3])}, [3])
    after = TensorDict({"a": TensorDict({"age": age + 10}, [3]), "b": TensorDict({}, [3])}, [3])
    ended = EndedRows()
    ended.keep(torch.tensor([True, False, False]), before)
    ended.keep(torch.tensor([False, True, False]), after)
    assert ended.restore(after.clone())["a", "age"].tolist() == [0, 11, 12]
