"""The loop on a small highway: it learns, logs, stops, and resumes to the same weights."""

import os
import signal
import time

import pytest
import torch
from agents.agents_small import same_weights, transitions
from reference.marks import needs_fork
from training.small_runs import OBSERVATION_SIZE, agent, road, rows, settings, signal_at, train

from ganlane.agents import Rainbow, RainbowConfig, load_agent
from ganlane.training import checkpoint, loop
from ganlane.training.checkpoint import LAST, Checkpointer, TrainingState, load_checkpoint

#: So long that the buffer is full for a while.
WHOLE = settings(480, log_every=240)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The agent and the folder of a run in one piece."""
    folder = tmp_path_factory.mktemp("whole")
    learner = agent()
    train(road(), learner, WHOLE, folder)
    return learner, folder


def test_the_agent_learns_to_stay_on_the_road(tmp_path):
    train(road(16), agent(), settings(1600), tmp_path)
    first, *_, last = rows(tmp_path / "metrics.csv")
    assert first["out_of_road_rate"] > 0.5
    assert last["out_of_road_rate"] < 0.2
    assert last["mean_return"] > first["mean_return"] + 100.0


def test_the_rows_of_the_metrics_hold_what_happened(whole):
    learner, folder = whole
    first, last = rows(folder / "metrics.csv")
    assert (first["decisions"], last["decisions"]) == (240, 480)
    # The updates of the last 8 decisions are still due: they are made while the next are driven.
    assert last["updates"] == learner.updates == (480 - 64 - 3 * 8 + 8) // 8
    assert sum(last[f"action_{i}_share"] for i in range(3)) == pytest.approx(1.0, abs=1e-4)
    assert last["goal_rate"] + last["out_of_road_rate"] == pytest.approx(1.0, abs=1e-4)
    of_updates = {"loss", "mean_q", "clamped_fraction", "sigma", "priority"}
    assert last.keys() >= of_updates | {"mean_discounted_return", "lane_changes_per_km"}


@pytest.mark.parametrize("environments", [4, 32])
def test_there_is_one_update_per_decisions_per_update_whatever_the_batch(environments, tmp_path):
    learner = agent(warmup=96, decisions_per_update=16, n_step=1)
    train(road(environments), learner, settings(480), tmp_path)
    assert abs(learner.updates - (480 - 96) // 16) <= 2


@pytest.mark.parametrize("decisions", [8, 400])  # while the buffer is empty, and when it is full
def test_an_interrupted_and_resumed_run_gives_the_same_weights(decisions, whole, tmp_path, capsys):
    first = train(road(), agent(), settings(decisions, log_every=240), tmp_path)
    torch.manual_seed(99)
    resumed = agent(seed=5)
    result = train(road(), resumed, WHOLE, tmp_path, resume=first.checkpoint)
    assert same_weights(whole[0], resumed)
    assert "bit-exact" not in capsys.readouterr().err
    assert result.progress["decisions"] == 480
    assert result.progress["updates"] == whole[0].updates
    ours, theirs = (rows(folder / "metrics.csv") for folder in (tmp_path, whole[1]))
    assert len(ours) == len(theirs)
    for column in ("decisions", "loss", "mean_return", "out_of_road_rate"):
        assert [row[column] for row in ours] == [row[column] for row in theirs]


def test_a_light_checkpoint_refills_the_buffer_before_its_first_update_and_says_so(
    tmp_path, capsys
):
    first = train(road(), agent(), settings(160, checkpoint_replay=False), tmp_path)
    resumed = agent()
    light = settings(216, progress=True)
    result = train(road(), resumed, light, tmp_path, resume=first.checkpoint)
    assert "not bit-exact" in capsys.readouterr().err
    assert len(resumed.replay) == 40  # 7 steps of 8, of which the new window of 3 still holds 2
    assert result.progress["updates"] == first.progress["updates"]
    more = settings(224 + 32)
    result = train(road(), resumed, more, tmp_path, resume=first.checkpoint)
    assert result.progress["updates"] == first.progress["updates"] + 3


def test_a_light_checkpoint_of_the_full_sized_network_is_under_5_mb(tmp_path):
    config = RainbowConfig(batch_size=64, warmup=64, decisions_per_update=8)
    learner = Rainbow(config, OBSERVATION_SIZE)
    learner.store(transitions(OBSERVATION_SIZE))
    learner.update()
    light = settings(480, checkpoint_replay=False)
    Checkpointer(TrainingState(road(), learner), tmp_path, light, {}).save()
    assert 3e6 < (tmp_path / "checkpoints" / "last.pt").stat().st_size < 5e6


def test_a_signal_ends_the_run_after_its_step_with_a_checkpoint(whole, tmp_path):
    number = signal.SIGTERM
    handler = signal.getsignal(number)
    with signal_at(160, number):
        stopped = loop.train(road(), agent(), WHOLE, tmp_path)
    assert stopped.stopped_by == number
    assert stopped.progress["decisions"] == 160
    assert signal.getsignal(number) == handler
    resumed = agent()
    train(road(), resumed, WHOLE, tmp_path, resume=stopped.checkpoint)
    assert same_weights(whole[0], resumed)


def test_the_best_evaluated_agent_is_kept_and_the_last_one_too(tmp_path):
    learner = agent()
    scores = iter([1.0, 3.0, 2.0])
    seen = []

    def evaluate(policy):
        seen.append(learner.weights()["head.weight_mu"])
        return {"mean_reward": next(scores), "crash_rate": 0.5}

    often = settings(240, evaluate_every=80)
    result = train(road(), learner, often, tmp_path, evaluate)
    assert result.best == 3.0
    assert [row["mean_reward"] for row in rows(tmp_path / "evaluation.csv")] == [1.0, 3.0, 2.0]
    (best, metadata), (last, _) = (
        load_agent(tmp_path / "checkpoints" / f"{name}.safetensors") for name in ("best", "last")
    )
    assert torch.equal(best.network.head.weight_mu, seen[1])
    assert torch.equal(last.network.head.weight_mu, learner.weights()["head.weight_mu"])
    assert metadata["training"]["mean_reward"] == 3.0
    assert metadata["training"]["decisions"] == 160


def train_until_killed(folder):
    """A run without an end, which saves whenever it may, in a child; its process."""
    child = os.fork()
    if child == 0:
        try:
            checkpoint.PATIENCE = 0.0
            train(road(), agent(), settings(10**9, checkpoint_every_s=0.0), folder)
        finally:
            os._exit(1)
    return child


@needs_fork
def test_a_run_killed_at_any_moment_is_resumed_to_the_same_weights(tmp_path):
    """Killed a tenth of a second after its first checkpoint; other moments are in tests/trial."""
    folder = tmp_path / "parts"
    last = folder / LAST
    child = train_until_killed(folder)
    while not last.exists():
        assert os.waitpid(child, os.WNOHANG) == (0, 0)
        time.sleep(0.01)
    time.sleep(0.11)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    more = settings(int(load_checkpoint(last)["counters"]["decisions"]) + 160)
    resumed, whole = agent(seed=5), agent()
    train(road(), resumed, more, folder, resume=last)
    train(road(), whole, more, tmp_path / "whole")
    assert same_weights(whole, resumed)
