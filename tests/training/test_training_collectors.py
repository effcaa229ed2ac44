"""Driving while learning.

Whose weights choose, the same bits after every end, one sentence for a lost worker.
"""

import dataclasses
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from training.test_training_loop import agent, same, settings, train
from training.toy import ROAD, ToyRoad, check_order, gone, road, steps, toy
from training.toy import agent as road_agent

from ganlane import keys
from ganlane.settings.traffic import IdmTrafficConfig
from ganlane.settings.train import CollectorConfig, OverlapCollectorConfig, TrainConfig
from ganlane.errors import ParameterError, UserError
from ganlane.training.checkpoint import load_checkpoint
from ganlane.training.collectors import (
    OverlapCollector,
    SingleCollector,
    pack,
    shielded_children,
    unpack,
    work,
)
from ganlane.training.phases import identity, make_collector, phases_of


class Thread(threading.Thread):
    """A worker in this process, which a pipe that is closed ends."""

    exitcode = 0


class HereCollector(OverlapCollector):
    """Workers are threads; ``late_s`` is what a worker waits before it starts."""

    late_s = 0.0

    def _start_worker(self, make):
        late_s = self.late_s * (len(self._pipes) + 1)

        def target():
            time.sleep(late_s)
            work(theirs, make)

        ours, theirs = multiprocessing.Pipe()
        self._processes.append(Thread(target=target, daemon=True))
        self._processes[-1].start()
        self._pipes.append(ours)


class Twin(SingleCollector):
    """The same in one process: actions are chosen before the updates, and driven after them."""

    overlaps = True

    def begin(self, agent):
        self.given = agent.policy(self.env_state)

    def step(self, agent):
        step, self.env_state = self.env.step_and_maybe_reset(self.given)
        return step


def run(source, decisions, folder, seed=0, **options):
    """The agent and the result of a run with ``source``."""
    learner = agent(seed)
    with closing(source):
        return learner, train(source, learner, settings(decisions), folder, **options)


def test_a_tensordict_is_packed_with_its_nested_batch_sizes():
    inner = TensorDict({"a": torch.zeros(2, 3, 1)}, [2, 3])
    whole = TensorDict({"inner": inner, "b": torch.ones(2)}, [2])
    back = unpack(pack(whole))
    assert back["inner"].batch_size == (2, 3)
    assert (back == whole).all()


# --- the same bits


def test_driving_while_learning_is_choosing_before_the_updates_of_the_step_before(tmp_path):
    ours, result = run(HereCollector(toy, 1, 8), 240, tmp_path / "here")
    twin, _ = run(Twin(ToyRoad(8)), 240, tmp_path / "twin")
    single, before = run(SingleCollector(ToyRoad(8)), 240, tmp_path / "single")
    assert same(ours, twin)
    assert not same(ours, single)
    assert result.updates == before.updates - 1  # those of the last step are still to come


def test_it_does_not_matter_which_worker_is_the_slowest(tmp_path):
    class Late(HereCollector):
        late_s = 0.2

    assert same(
        run(HereCollector(toy, 2, 8), 160, tmp_path)[0],
        run(Late(toy, 2, 8), 160, tmp_path / "late")[0],
    )


@pytest.mark.parametrize("decisions", [24, 160])
def test_an_interrupted_and_resumed_run_gives_the_same_weights(decisions, tmp_path, capsys):
    whole, _ = run(HereCollector(toy, 2, 8), 240, tmp_path / "whole")
    _, first = run(HereCollector(toy, 2, 8), decisions, tmp_path / "parts")
    resumed, _ = run(
        HereCollector(toy, 2, 8), 240, tmp_path / "parts", seed=5, resume=first.checkpoint
    )
    assert same(whole, resumed)
    assert "bit-exact" not in capsys.readouterr().err


def test_the_state_of_a_highway_is_taken_over_row_by_row():
    learner = road_agent()
    with closing(HereCollector(road, 2, 6)) as first, closing(HereCollector(road, 2, 6)) as second:
        steps(first, learner, 3)
        second.load_state_dict(first.state_dict(True), True)
        noise = learner.generators["collect"].get_state()
        expected = first.step(learner).clone()
        learner.generators["collect"].set_state(noise)
        found = second.step(learner)
        for key in (keys.OBSERVATION, keys.ACTION, ("next", keys.OBSERVATION), ("next", "done")):
            assert torch.equal(found[key], expected[key])
        second.load_state_dict(first.state_dict(False), False)
        assert second.step(learner)[keys.STEP].eq(0).all()  # the next episodes, from their start


def test_steps_come_in_the_order_of_time_and_no_two_workers_drive_the_same_episode():
    with closing(HereCollector(road, 2, 6)) as source:
        seen = steps(source, road_agent(), 30)
    assert seen["next", "done"].any()
    check_order(seen, [0, 1, 2, 2**40, 2**40 + 1, 2**40 + 2])
    assert keys.TRAFFIC not in seen


# --- options


def test_a_phase_collects_as_the_option_says():
    config = TrainConfig(
        collector=OverlapCollectorConfig(6, 3), traffic=IdmTrafficConfig(), env=ROAD
    )
    (phase,) = phases_of(config, Path("nowhere"))
    source = make_collector(config, phase)
    assert isinstance(source, OverlapCollector)
    assert (source.environments, source.rows) == (6, 2)


def test_environments_that_cannot_be_shared_out_are_refused():
    with pytest.raises(ParameterError, match="evenly"):
        OverlapCollectorConfig(7, 2)


@pytest.mark.parametrize("resumed", [OverlapCollectorConfig(8, 2), CollectorConfig(8)])
def test_a_run_is_not_resumed_with_the_other_collector(resumed, tmp_path):
    started = (
        CollectorConfig(8)
        if isinstance(resumed, OverlapCollectorConfig)
        else OverlapCollectorConfig(8, 2)
    )
    config = TrainConfig(collector=started, traffic=IdmTrafficConfig(), env=ROAD)
    (phase,) = phases_of(config, tmp_path)
    _, first = run(SingleCollector(ToyRoad(8)), 40, tmp_path, identity=identity(config, phase))
    other = identity(dataclasses.replace(config, collector=resumed), phase)
    with pytest.raises(UserError, match=r"collector\.overlaps="):
        run(SingleCollector(ToyRoad(8)), 80, tmp_path, resume=first.checkpoint, identity=other)


# --- processes


def test_children_of_a_run_are_spared_its_signals():
    with shielded_children():
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            child.send_signal(number)
        time.sleep(0.5)
        assert child.poll() is None
    finally:
        child.kill()
        child.wait()


def test_a_signal_that_comes_while_children_start_is_not_lost_nor_its_handler():
    seen = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: seen.append(number))
    try:
        with shielded_children():
            os.kill(os.getpid(), signal.SIGTERM)
        with shielded_children():
            # as ray.init does
            signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(number))
        os.kill(os.getpid(), signal.SIGTERM)
        assert seen == [signal.SIGTERM, signal.SIGTERM]
    finally:
        signal.signal(signal.SIGTERM, before)


def test_processes_give_what_threads_give_and_a_lost_one_ends_the_run_in_one_sentence():
    learner, other = agent(), agent()
    with closing(OverlapCollector(toy, 1, 4)) as source, closing(HereCollector(toy, 1, 4)) as here:
        for _ in range(3):
            ours, theirs = source.step(learner), here.step(other)
            assert torch.equal(ours["next", "reward"], theirs["next", "reward"])
        numbers = [process.pid for process in source._processes]
        os.kill(numbers[0], signal.SIGKILL)
        with pytest.raises(
            UserError, match=r"^collector=overlap: worker 0 .*died.* go on from the last"
        ) as error:
            source.step(learner)
        assert "\n" not in str(error.value)
    assert not any(Path(f"/proc/{number}").exists() for number in numbers)


KILLED = """
import sys
import torch
torch.set_num_threads(1)
sys.path[:0] = [{tests!r}]
from training.test_training_collectors import OverlapCollector, SingleCollector, ToyRoad, agent, settings, toy, train
import ganlane.training.checkpoint as checkpoint
checkpoint.PATIENCE = 0.0
if __name__ == "__main__":
    train({source}, agent(), settings(10**9, checkpoint_every_s=0.0), {folder!r})
"""
#: What a killed run collects with, and its like in this process.
SOURCES = {
    "SingleCollector(ToyRoad(8))": lambda: SingleCollector(ToyRoad(8)),
    "OverlapCollector(toy, 2, 8)": lambda: HereCollector(toy, 2, 8),
}
SINGLE, OVERLAP = SOURCES
ATTEMPTS = [(SINGLE, 0, 0.0), (SINGLE, 0, 0.53), (OVERLAP, 160, 0.1), (OVERLAP, 160, 0.7)]


@pytest.mark.parametrize(
    ("source", "decisions", "after_s"),
    [(SINGLE, 0, 0.11), *(pytest.param(*attempt, marks=pytest.mark.slow) for attempt in ATTEMPTS)],
)
def test_a_run_killed_at_any_moment_is_resumed_to_the_same_weights_and_leaves_no_process(
    source, decisions, after_s, tmp_path
):
    """Killed so many seconds after its checkpoint of so many ``decisions``."""
    folder, tests, script = (
        tmp_path / "parts",
        Path(__file__).resolve().parent.parent,
        tmp_path / "killed.py",
    )
    script.write_text(KILLED.format(tests=str(tests), folder=str(folder), source=source))
    process = subprocess.Popen(
        [sys.executable, str(script)], cwd=tests.parent, start_new_session=True
    )
    last = folder / "checkpoints" / "last.pt"
    while not last.exists() or load_checkpoint(last)["counters"]["decisions"] < decisions:
        assert process.poll() is None
        time.sleep(0.01)
    time.sleep(after_s)
    process.kill()
    process.wait()
    assert gone(process.pid)
    reached = int(load_checkpoint(last)["counters"]["decisions"])
    resumed, _ = run(SOURCES[source](), reached + 400, folder, seed=5, resume=last)
    whole, _ = run(SOURCES[source](), reached + 400, tmp_path / "whole")
    assert same(whole, resumed)
