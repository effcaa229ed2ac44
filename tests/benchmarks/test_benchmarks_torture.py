"""The trial of the package: what breaks is seen, and what holds is counted."""

from __future__ import annotations

import os
import random
import signal
import time

import pytest
import torch

import ganlane
from benchmarks.torture import damages
from benchmarks.torture.damage import Trial, same
from benchmarks.torture.readers import READERS, SCENE, Reader
from benchmarks.torture.soak import actions, violations
from benchmarks.torture.tally import Tally, forked
from benchmarks.torture.versions import dependencies, lowest
from ganlane import keys
from ganlane.errors import UserError

CHOICE = {"traffic": {"name": "idm_mobil"}, "policy": "random", "env": "highway"}

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")


def work(item):
    """Does what its item says, in a child."""
    if item == "dies":
        os.kill(os.getpid(), signal.SIGKILL)
    if item == "hangs":
        time.sleep(60)
    return item.upper()


def test_an_item_that_ends_or_hangs_its_process_is_reported_and_the_others_are_done():
    done = dict(forked(work, ["a", "dies", "b", "hangs", "c"], at_most_s=1.0, memory_gib=64.0))
    assert (done["a"], done["b"], done["c"]) == ("A", "B", "C")
    assert done["dies"] == "LOST: the process ended (status 9)"
    assert done["hangs"] == "LOST: more than 1 s"


@pytest.fixture
def trial(tmp_path, monkeypatch):
    """A trial with one good file, whose reader the test chooses."""
    good = tmp_path / "good"
    good.mkdir()
    (good / "scene.csv").write_text(SCENE)
    monkeypatch.chdir(tmp_path)

    def of(read, sealed=False, way=damages.flip):
        monkeypatch.setitem(READERS, "file", Reader("scene.csv", read, (way,), sealed))
        return Trial(good, tmp_path / "damaged")(("file", 3))

    return of


def refuses(path):
    raise UserError("a sentence")


def test_a_reader_is_judged_by_how_it_ends(trial):
    assert trial(refuses) == "REFUSED a sentence"
    assert trial(lambda path: path.stat().st_size) == "READ"
    assert trial(lambda path: 1 // 0).startswith("TRACEBACK after flip: ZeroDivisionError")
    assert trial(lambda path: print("EXECUTED")) == "TRACEBACK the code of a bomb ran"


def test_another_content_of_a_sealed_file_must_not_pass_in_silence(trial):
    assert trial(lambda path: path.read_bytes(), sealed=True) == "ACCEPTED after flip, in silence"
    assert trial(lambda path: 3, sealed=True) == "READ"
    assert not same({"a": torch.zeros(2)}, {"a": torch.tensor([0.0, -0.0])})


@pytest.mark.parametrize("way", list(dict.fromkeys(damages.TEXT)), ids=lambda way: way.__name__)
def test_damage_changes_a_file_and_is_the_same_for_the_same_number(way):
    one, other = (
        [way(random.Random(number), SCENE.encode()) for number in range(20)] for _ in range(2)
    )
    assert one == other
    assert sum(each != SCENE.encode() for each in one) > 15


@pytest.fixture(scope="module")
def decision():
    """An environment, and the states before and after a decision and after its resets."""
    env = ganlane.make_env("idm_mobil", 8, goal_m=60.0, mask="legal")
    td, generator = env.reset(), torch.Generator().manual_seed(0)
    ended = False
    while not ended:
        td["action"] = actions("random", td, generator)
        before = td
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
    assert any(told in each for each in violations(env.base_env, CHOICE, before, broken, following))


def test_a_mask_without_any_action_is_seen(decision):
    env, before, after, following = decision
    none = following.clone().set(keys.ACTION_MASK, torch.zeros(8, 3, dtype=torch.bool))
    assert list(violations(env.base_env, CHOICE, before, after, none)) == ["no action allowed"]


def test_every_dependency_has_a_lower_bound():
    assert len([lowest(each) for each in dependencies()]) > 10
    assert lowest("torch>=2.11,<2.14") == "torch==2.11"


def test_failures_are_counted_even_where_they_are_no_longer_kept(capsys):
    tally = Tally("part")
    for number in range(60):
        tally.fail(str(number))
    tally.what["files"] += 1000
    assert tally.row() == "| part | 1,000 files | 60 | 0.0 |"
    assert len(tally.plain()["failures"]) == 50
