"""The loop on a toy road: it learns, logs, stops, and resumes to the same weights."""

import csv
import os
import signal
import time

import pytest
import torch
from agents.agents_small import transitions
from torchrl.envs.utils import check_env_specs
from training.toy import ToyRoad, same

from ganlane.agents import Rainbow, RainbowConfig, load_agent
from ganlane.settings.train import LoggerConfig, TrainConfig
from ganlane.training.checkpoint import Checkpointer, TrainingState
from ganlane.training.loop import train as train_until_stopped

SMALL = {
    "hidden": (32, 32),
    "batch_size": 64,
    "capacity": 1000,
    "warmup": 64,
    "decisions_per_update": 8,
    "v_min": -10.0,
    "v_max": 10.0,
    "atoms": 21,
    "target_period": 20,
    "learning_rate": 3e-3,
    "gamma": 0.8,
    "epsilon_start": 0.0,
    "epsilon": 0.0,
}


def agent(seed=0, **options):
    return Rainbow(RainbowConfig(**{**SMALL, **options}), 4, seed=seed)


def settings(decisions, progress=False, **options):
    logger = LoggerConfig(progress=progress)
    return TrainConfig(
        total_decisions=decisions,
        logger=logger,
        **{"log_every": 400, **options},
    )


def train(*arguments, **options):
    """A run to its end.

    One that a signal stops, say the SIGTERM of `timeout`, would fail here as other weights.
    """
    result = train_until_stopped(*arguments, **options)
    if result.stopped_by is not None:
        pytest.exit(
            f"a run was stopped by signal {result.stopped_by}",
            returncode=128 + result.stopped_by,
        )
    return result


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_the_toy_road_is_a_torchrl_environment():
    check_env_specs(ToyRoad())


def test_the_agent_learns_to_drive_on_the_toy_road(tmp_path):
    train(ToyRoad(16), agent(), settings(8000), tmp_path)
    figures = rows(tmp_path / "metrics.csv")
    first = figures[0]
    last = figures[-1]
    assert float(first["crash_rate"]) > 0.5
    assert float(last["crash_rate"]) < 0.2
    assert float(last["mean_return"]) > float(first["mean_return"]) + 5.0


def test_the_rows_of_the_metrics_hold_what_happened_and_the_global_random_state_is_left_alone(
    tmp_path,
):
    learner = agent()
    random_state = torch.get_rng_state()
    train(ToyRoad(8), learner, settings(1600), tmp_path)
    assert torch.equal(torch.get_rng_state(), random_state)
    figures = rows(tmp_path / "metrics.csv")
    assert [int(row["decisions"]) for row in figures] == [
        400,
        800,
        1200,
        1600,
    ]
    last = {name: float(value) for name, value in figures[-1].items()}
    # The updates of the last 8 decisions are still due: they are made while the next are driven.
    assert last["updates"] == learner.updates == (1600 - 64 - 3 * 8 + 8) // 8
    assert sum(last[f"action_{i}_share"] for i in range(3)) == pytest.approx(1.0, abs=1e-4)
    assert last["goal_rate"] + last["crash_rate"] == pytest.approx(1.0, abs=1e-4)
    assert 0.0 < last["lane_changes_per_km"] < 10.0
    assert {
        "loss",
        "mean_q",
        "clamped_fraction",
        "sigma",
        "priority",
        "mean_discounted_return",
    } <= last.keys()


@pytest.mark.parametrize("environments", [4, 8, 32])
def test_there_is_one_update_per_decisions_per_update_whatever_the_batch(environments, tmp_path):
    learner = agent(warmup=96, decisions_per_update=16, n_step=1)
    train(ToyRoad(environments), learner, settings(960), tmp_path)
    assert abs(learner.updates - (960 - 96) // 16) <= 2


@pytest.mark.parametrize("decisions", [40, 1200])  # before the buffer is full, and after
def test_an_interrupted_and_resumed_run_gives_the_same_weights(decisions, tmp_path, capsys):
    whole = agent()
    train(ToyRoad(8), whole, settings(2400), tmp_path / "whole")
    first = train(ToyRoad(8), agent(), settings(decisions), tmp_path / "parts")
    torch.manual_seed(99)
    resumed = agent(seed=5)
    result = train(
        ToyRoad(8),
        resumed,
        settings(2400),
        tmp_path / "parts",
        resume=first.checkpoint,
    )
    assert same(whole, resumed)
    assert "bit-exact" not in capsys.readouterr().err
    assert (result.decisions, result.updates) == (
        2400,
        whole.updates,
    )
    columns = ("decisions", "loss", "mean_return", "crash_rate")
    ours, theirs = (rows(tmp_path / name / "metrics.csv") for name in ("parts", "whole"))
    assert [[row[c] for c in columns] for row in ours] == [
        [row[c] for c in columns] for row in theirs
    ]


def test_a_light_checkpoint_refills_the_buffer_before_its_first_update_and_says_so(
    tmp_path, capsys
):
    first = train(
        ToyRoad(8),
        agent(),
        settings(800, checkpoint_replay=False),
        tmp_path,
    )
    resumed = agent()
    light = settings(856, progress=True)
    result = train(
        ToyRoad(8),
        resumed,
        light,
        tmp_path,
        resume=first.checkpoint,
    )
    assert "not bit-exact" in capsys.readouterr().err
    assert len(resumed.replay) == 40  # 7 steps of 8, of which the new window of 3 still holds 2
    assert result.updates == first.updates
    result = train(
        ToyRoad(8),
        resumed,
        settings(864 + 32),
        tmp_path,
        resume=first.checkpoint,
    )
    assert result.updates == first.updates + 3


def test_a_light_checkpoint_of_the_full_sized_network_is_under_5_mb(
    tmp_path,
):
    learner = Rainbow(
        RainbowConfig(batch_size=64, warmup=64, decisions_per_update=8),
        29,
    )
    learner.store(transitions(29))
    learner.update()
    Checkpointer(
        TrainingState(ToyRoad(8), learner),
        tmp_path,
        20.0,
        False,
        {},
    ).save()
    assert 3e6 < (tmp_path / "checkpoints" / "last.pt").stat().st_size < 5e6


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_run_after_its_step_with_a_checkpoint(number, tmp_path):
    class Interrupting(ToyRoad):
        steps = 0

        def _step(self, tensordict):
            self.steps += 1
            if self.steps == 20:
                os.kill(os.getpid(), number)
            return super()._step(tensordict)

    handler = signal.getsignal(number)
    stopped = train_until_stopped(Interrupting(8), agent(), settings(2400), tmp_path / "parts")
    assert stopped.stopped_by == number
    assert stopped.decisions == 160
    assert signal.getsignal(number) == handler
    whole = agent()
    resumed = agent()
    train(ToyRoad(8), whole, settings(800), tmp_path / "whole")
    train(
        ToyRoad(8),
        resumed,
        settings(800),
        tmp_path / "parts",
        resume=stopped.checkpoint,
    )
    assert same(whole, resumed)


def test_the_best_evaluated_agent_is_kept_and_the_last_one_too(
    tmp_path,
):
    learner = agent()
    scores = iter([1.0, 3.0, 2.0])
    seen = []

    def evaluate(policy):
        seen.append(learner.weights())
        return {"mean_reward": next(scores), "crash_rate": 0.5}

    result = train(
        ToyRoad(8),
        learner,
        settings(1200, evaluate_every=400),
        tmp_path,
        evaluate,
    )
    assert result.best == 3.0
    assert [row["mean_reward"] for row in rows(tmp_path / "evaluation.csv")] == ["1", "3", "2"]
    policy, metadata = load_agent(
        tmp_path / "checkpoints" / "best.safetensors",
        observation_size=4,
    )
    assert metadata["training"]["mean_reward"] == 3.0
    assert metadata["training"]["decisions"] == 800
    assert torch.equal(policy.network.head.weight_mu, seen[1]["head.weight_mu"])
    policy, _ = load_agent(tmp_path / "checkpoints" / "last.safetensors")
    assert torch.equal(
        policy.network.head.weight_mu,
        learner.weights()["head.weight_mu"],
    )


def test_writing_checkpoints_takes_at_most_a_fiftieth_of_the_time(tmp_path, monkeypatch):
    saver = Checkpointer(TrainingState(ToyRoad(8), agent()), tmp_path, 0.0, True, {})
    monkeypatch.setattr(
        "ganlane.training.checkpoint.save_checkpoint",
        lambda path, state: time.sleep(0.1),
    )
    saver.save()
    assert saver.pause_s > 5.0
    assert not saver.due()
