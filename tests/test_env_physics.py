"""The physics of a decision: what is remembered of rows that have ended, and compiled graphs."""

from __future__ import annotations

import shutil

import pytest
import torch
from reference.worlds import environment, leaves, same_bits, step

from ganlane import build, keys, runtime
from ganlane.agents.drivers import MobilDriver
from ganlane.env import HighwayEnv
from ganlane.env.physics import EndedRows
from ganlane.errors import UserError
from ganlane.settings.driving import Visibility
from ganlane.settings.env import EnvConfig
from ganlane.settings.traffic import IdmTrafficConfig
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


# HighwayEnv.compile(): the same drive to rounding, and one sentence where it cannot be


def test_without_a_compiler_on_the_path_one_sentence_says_so(monkeypatch):
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(
        UserError, match=r"^compile=true needs a C\+\+ compiler, and there is none \(looked"
    ):
        runtime.check_compiler()
    with pytest.raises(UserError, match="apt install"):
        environment(vehicles=3).compile()


def test_the_compiler_that_cxx_names_is_the_one_that_is_looked_for(monkeypatch):
    monkeypatch.setenv("CXX", "my-compiler")
    monkeypatch.setattr(shutil, "which", lambda name: "/bin/g++" if name == "g++" else None)
    with pytest.raises(UserError, match="looked for CXX=my-compiler"):
        runtime.check_compiler()
    monkeypatch.delenv("CXX")
    monkeypatch.setattr(runtime, "_compiles", lambda path: path == "/bin/g++")
    runtime.check_compiler()


@pytest.mark.parametrize("lines", ["exit 1", "exit 0"])
def test_a_compiler_that_makes_nothing_is_none(lines, monkeypatch, tmp_path):
    program = tmp_path / "compiler"
    program.write_text(f"#!/bin/sh\n{lines}\n")
    program.chmod(0o755)
    monkeypatch.setenv("CXX", str(program))
    assert not runtime.has_compiler()
    with pytest.raises(UserError, match=f"compiler, and {program} fails; install one"):
        runtime.check_compiler()


def test_arguments_of_torchrls_version_are_refused():
    with pytest.raises(UserError, match="takes no arguments, not mode, dynamic"):
        environment(vehicles=3).compile(mode="reduce-overhead", dynamic=True)


@pytest.mark.parametrize("asked", [True, False])
def test_env_compile_reaches_the_environment_and_the_observation(asked, monkeypatch):
    seen = []
    monkeypatch.setattr(HighwayEnv, "compile", lambda env: seen.append("environment"))
    monkeypatch.setattr(
        build.ObservationTransform, "compile_graphs", lambda transform: seen.append("observation")
    )
    config = EnvConfig(vehicles=3, compile=asked)
    build.make_env(build.make_traffic(IdmTrafficConfig(), config), config)
    assert seen == (["environment", "observation"] if asked else [])


def test_torchrls_keyword_calls_it_too(monkeypatch):
    seen = []
    monkeypatch.setattr(HighwayEnv, "compile", lambda env, **options: seen.append(options) or env)
    HighwayEnv(environment(vehicles=3).traffic, vehicles=3, compile=True)
    assert seen == [{}]


@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, runtime.COMPILERS)), reason="no C++ compiler")
def test_a_compiled_environment_drives_as_the_eager_one_to_rounding():
    """In float64: 20 decisions of 4 rows, several episodes each, with vehicles that return."""
    settings = {"num_envs": 4, "vehicles": 4, "goal_m": 150.0, "recycle": True}
    eager = environment(**settings)
    compiled = environment(**settings)
    assert compiled.compile() is compiled
    driver = MobilDriver(eager.road)
    one, other = eager.reset(), compiled.reset()
    for _ in range(20):
        expected, one = eager.step_and_maybe_reset(driver(one))
        actual, other = compiled.step_and_maybe_reset(driver(other))
        for name, value in leaves(expected["next"]):
            torch.testing.assert_close(value, actual["next", name], rtol=1e-9, atol=1e-9)
    assert one[keys.EPISODE].max() >= 8
