"""The trial of the package: what breaks is seen, and what holds is counted."""

import os
import signal
import time

import pytest
import torch
from trial import damages
from trial.damage import READERS, SCENE, Reader, Trial
from trial.kill import TINY, differences, torn_write, train
from trial.soak import actions, violations
from trial.tally import FORK, forked

import ganlane
from ganlane import keys
from ganlane.errors import UserError
from ganlane.files import write_bytes

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
CHOICE = {"traffic": {"name": "idm_mobil"}, "policy": "random", "env": "highway"}


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
    assert done["dies"] == "LOST: the process ended (status -9)"
    assert done["hangs"].startswith("LOST: more than 1 s")


def refuses(path):
    raise UserError("a sentence")


def bombs(path):
    print("EXECUTED")
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


def test_other_weights_figures_and_parts_of_files_are_seen(tmp_path):
    whole, other = tmp_path / "whole", tmp_path / "other"
    line = ["traffic=idm", "init=none", "total_decisions=96", "evaluate_every=0"]
    for folder, seed in ((whole, 0), (other, 1)):
        assert train([*TINY, *line, f"seed={seed}", f"hydra.run.dir={folder}"]) == 0
    assert differences(whole, whole) == []
    (other / ".metrics.csv.part").touch()
    wrong = differences(other, whole)
    assert "left behind: .metrics.csv.part" in wrong
    assert "other weights in agent.safetensors" in wrong
    assert "other figures in metrics.csv" in wrong


def test_the_second_write_is_torn_and_the_file_before_stays(tmp_path):
    def write_twice():
        torn_write(1, 0.5)()
        for content in (b"first", b"second"):
            write_bytes(tmp_path / "file", content)

    child = FORK.Process(target=write_twice)
    child.start()
    child.join()
    assert child.exitcode == -signal.SIGKILL
    assert (tmp_path / "file").read_bytes() == b"first"


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
