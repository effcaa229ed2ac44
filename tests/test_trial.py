"""The trial of the package sees what breaks: damaged files that are read, broken invariants."""

from pathlib import Path

import pytest
import torch
from reference.marks import needs_fork
from trial import damages
from trial.damage import READERS, SCENE, Reader, Trial
from trial.soak import actions, violations

import ganlane
from ganlane import keys
from ganlane.errors import UserError

pytestmark = needs_fork
CHOICE = {"traffic": {"name": "idm_mobil"}, "policy": "random", "env": "highway"}


def refuses(path):
    raise UserError("a sentence")


def bombs(path):
    Path("executed").touch()
    raise UserError("a sentence")


@pytest.mark.parametrize(
    ("read", "sealed", "result"),
    [
        (refuses, False, "REFUSED a sentence"),
        (lambda path: path.stat().st_size, False, "READ"),
        (lambda path: 1 // 0, False, "TRACEBACK after flip: ZeroDivisionError"),
        (bombs, False, "TRACEBACK the code of a bomb ran"),
        (lambda path: path.read_bytes(), True, "ACCEPTED after flip, in silence"),
        (lambda path: print("a note") or path.read_bytes(), True, "TOLD a note"),
        (lambda path: 3, True, "READ"),
    ],
)
def test_a_reader_is_judged_by_how_it_ends(read, sealed, result, tmp_path, monkeypatch):
    good = tmp_path / "good"
    good.mkdir()
    (good / "scene.csv").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(READERS, "file", Reader("scene.csv", read, (damages.flip,), sealed))
    assert Trial(good, tmp_path / "damaged")(("file", 3)).startswith(result)


@pytest.fixture(scope="module")
def decision():
    """An environment, and the states before and after a decision and after its resets."""
    env = ganlane.make_env("idm_mobil", 8, goal_m=60.0, mask="legal")
    td, generator = env.reset(), torch.Generator().manual_seed(0)
    ended = False
    while not ended:
        before = td.set("action", actions("random", td, generator))
        stepped, td = env.step_and_maybe_reset(td)
        ended = stepped["next", "done"].any()
        assert list(violations(env.base_env, CHOICE, before, stepped["next"], td)) == []
    return env, before, stepped["next"], td


#: A violation: key of the state after the decision, what stands there, and how it is told.
BROKEN = {
    "not finite": ((keys.VEHICLES, "x"), float("nan")),
    "a negative speed": ((keys.VEHICLES, "speed"), -1.0),
    "faster than allowed": ((keys.VEHICLES, "speed"), 60.0),
    "a lane that is not there": ((keys.VEHICLES, "target_lane"), 3),
    "not exactly one reason": ((keys.EVENTS, "timeout"), True),
    "truncated without": (("truncated",), True),
    "another episode": ((keys.EPISODE,), 99),
    "distance fell": ((keys.EGO, "distance"), -1.0),
    "a decision of another length": ((keys.STEP,), 10**6),
}


@pytest.mark.parametrize("told", BROKEN)
def test_a_broken_invariant_is_seen(told, decision):
    env, before, after, following = decision
    key, value = BROKEN[told]
    broken = after.clone()
    broken[key] = torch.full_like(broken[key], value)
    wrong = violations(env.base_env, CHOICE, before, broken, following)
    assert any(told in text for text in wrong)
