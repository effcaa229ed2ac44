"""``HighwayEnv.compile()``: the same drive to rounding, and one sentence where it cannot be."""

from __future__ import annotations

import shutil

import pytest
import torch
from reference.worlds import environment
from tensordict import TensorDictBase

from ganlane import build, keys, runtime
from ganlane.agents.drivers import MobilDriver
from ganlane.config.env import EnvConfig
from ganlane.config.traffic import IdmTrafficConfig
from ganlane.env import HighwayEnv
from ganlane.errors import UserError


@pytest.fixture
def no_compiler(monkeypatch):
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(shutil, "which", lambda name: None)


def test_without_a_compiler_on_the_path_one_sentence_says_so(no_compiler):
    with pytest.raises(UserError, match=r"^compile=true needs a C\+\+ compiler, and there is none \(looked"):
        runtime.check_compiler()
    with pytest.raises(UserError, match="apt install"):
        environment(vehicles=3).compile()


def test_the_compiler_that_cxx_names_is_the_one_that_is_looked_for(monkeypatch):
    monkeypatch.setenv("CXX", "my-compiler")
    monkeypatch.setattr(shutil, "which", lambda name: "/bin/g++" if name == "g++" else None)
    with pytest.raises(UserError, match="looked for CXX=my-compiler"):
        runtime.check_compiler()
    monkeypatch.delenv("CXX")
    runtime.check_compiler()


def test_arguments_of_torchrls_version_are_refused():
    with pytest.raises(UserError, match="takes no arguments, not mode, dynamic"):
        environment(vehicles=3).compile(mode="reduce-overhead", dynamic=True)


@pytest.mark.parametrize("asked", [True, False])
def test_env_compile_reaches_the_environment_and_the_observation(asked, monkeypatch):
    seen = []
    monkeypatch.setattr(HighwayEnv, "compile", lambda env: seen.append("environment"))
    monkeypatch.setattr(build.ObservationTransform, "compile_graphs", lambda transform: seen.append("observation"))
    config = EnvConfig(vehicles=3, compile=asked)
    build.make_env(build.make_traffic(IdmTrafficConfig(), config), config)
    assert seen == (["environment", "observation"] if asked else [])


def test_torchrls_keyword_calls_it_too(monkeypatch):
    seen = []
    monkeypatch.setattr(HighwayEnv, "compile", lambda env, **given: seen.append(given) or env)
    HighwayEnv(environment(vehicles=3).traffic, vehicles=3, compile=True)
    assert seen == [{}]


def drive(env: HighwayEnv, decisions: int) -> list[TensorDictBase]:
    """States of a drive with automatic resets."""
    td, driver, states = env.reset(), MobilDriver(env.road), []
    for _ in range(decisions):
        stepped, td = env.step_and_maybe_reset(driver(td))
        states.append(stepped["next"].clone())
    return states


@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, runtime.COMPILERS)), reason="no C++ compiler")
def test_a_compiled_environment_drives_as_the_eager_one_to_rounding():
    """In float64: 20 decisions of 4 rows, several episodes each, with vehicles that return."""
    settings = {"num_envs": 4, "vehicles": 4, "goal_m": 150.0, "recycle": True}
    eager, compiled = environment(**settings), environment(**settings)
    assert compiled.compile() is compiled
    pairs = list(zip(drive(eager, 20), drive(compiled, 20)))
    assert sum(int(one["done"].sum()) for one, _ in pairs) >= 4
    assert pairs[-1][0][keys.EPISODE].max() >= 4
    for one, other in pairs:
        assert torch.equal(one["done"], other["done"])
        for name in (*keys.VEHICLE_FIELDS,):
            a, b = one[keys.VEHICLES, name], other[keys.VEHICLES, name]
            torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)
        for name in (*keys.END_EVENTS, keys.SOFT_CRASH):
            assert torch.equal(one[keys.EVENTS, name], other[keys.EVENTS, name])
        torch.testing.assert_close(one[keys.EGO, "distance"], other[keys.EGO, "distance"], rtol=1e-9, atol=1e-9)
