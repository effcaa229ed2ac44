"""The physics of a decision: what is remembered of rows that have ended, and compiled graphs."""

import pytest
import torch
from reference.worlds import environment, same_bits, step

from ganlane import keys, runtime
from ganlane.env.physics import EndedRows
from ganlane.settings.driving import Visibility
from ganlane.traffic import IdmTraffic, Overlay, TrafficModule, TrafficSequential

# What traffic remembers of a row that has ended is what it remembered when the row ended.


class Ageing(IdmTraffic):
    """Counts the physics steps that it was asked for."""

    memory_fields = {"age": ((), torch.int64), **IdmTraffic.memory_fields}  # noqa: RUF012

    def fresh_memory(self, vehicles, key):
        return {
            "age": torch.zeros_like(vehicles.target_lane),
            **super().fresh_memory(vehicles, key),
        }

    def move(self, vehicles, memory, key, step):
        moved, rest = super().move(vehicles, {"steering": memory["steering"]}, key, step)
        return moved, {"age": memory["age"] + 1, **rest}


class Forgetful(Overlay):
    """Remembers nothing."""

    def rewrite(self, vehicles, moved, memory, key, step):
        return moved, memory


def ages(traffic: TrafficModule, *name: str) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """After a decision in which rows end at all of its moments.

    Ages, physics steps and who ended, [N].
    """
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


@pytest.mark.parametrize("lines", ["exit 1", "exit 0"])
def test_a_compiler_that_makes_nothing_is_none(lines, monkeypatch, tmp_path):
    program = tmp_path / "compiler"
    program.write_text(f"#!/bin/sh\n{lines}\n")
    program.chmod(0o755)
    monkeypatch.setenv("CXX", str(program))
    assert not runtime.has_compiler()
