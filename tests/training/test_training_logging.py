"""Weights & Biases, the choice of logs, what the bar shows, and Q-values against realised returns."""

import io
import sys
import types

import pytest
import torch
from tensordict import TensorDict

from ganlane.config.train import LoggerConfig
from ganlane.errors import UserError
from ganlane.training.further import make_logs
from ganlane.training.log import COLUMNS
from ganlane.training.meter import Meter
from ganlane.training.progress import Progress
from ganlane.training.tensorboard import TensorBoardLog
from ganlane.training.wandb import WandbLog

# --- Weights & Biases


class FakeRun:
    def __init__(self):
        self.rows, self.finished = [], False

    def log(self, figures, step):
        self.rows.append((step, figures))

    def finish(self):
        self.finished = True


@pytest.fixture
def fake(monkeypatch):
    """A wandb that remembers what it was given; no process, no network."""
    module = types.ModuleType("wandb")
    module.Error = type("Error", (Exception,), {})
    module.Settings = lambda **options: options
    module.run, module.options = FakeRun(), {}

    def init(**options):
        module.options.update(options)
        return module.run

    module.init = init
    monkeypatch.setitem(sys.modules, "wandb", module)
    monkeypatch.delenv("WANDB_MODE", raising=False)
    return module


def test_wandb_is_offline_unless_the_environment_says_otherwise(fake, tmp_path, monkeypatch):
    WandbLog(tmp_path)
    assert fake.options["mode"] == "offline"
    monkeypatch.setenv("WANDB_MODE", "online")
    WandbLog(tmp_path)
    assert fake.options["mode"] == "online"


def test_wandb_writes_below_the_run_folder_and_is_named_after_it(fake, tmp_path):
    folder = tmp_path / "sweep" / "3"
    WandbLog(folder, "mine", {"seed": 7})
    assert fake.options["dir"] == str(folder)
    assert folder.is_dir()  # wandb falls back to a temporary folder otherwise
    assert (fake.options["project"], fake.options["name"]) == ("mine", "sweep/3")
    assert fake.options["config"] == {"seed": 7}


def test_wandb_gets_every_figure_over_the_decisions_and_is_finished(fake, tmp_path):
    log = WandbLog(tmp_path)
    log.write({"decisions": 100, "loss": 0.5, "mean_return": 3.0})
    log.close()
    assert fake.run.rows == [(100, {"loss": 0.5, "mean_return": 3.0})]
    assert fake.run.finished


def test_a_missing_wandb_is_named_with_the_command_that_mends_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(UserError, match=r"pip install 'ganlane\[wandb\]'.*logger=csv\.$"):
        WandbLog(tmp_path)


def test_a_wandb_that_does_not_start_is_one_sentence(fake, tmp_path, monkeypatch):
    def refuse(**options):
        raise fake.Error("api_key not configured")

    monkeypatch.setattr(fake, "init", refuse)
    monkeypatch.setenv("WANDB_MODE", "online")
    with pytest.raises(UserError, match=r"WANDB_MODE=online.*api_key not configured.*WANDB_MODE=offline"):
        WandbLog(tmp_path)


@pytest.mark.slow
def test_the_real_wandb_keeps_an_offline_run(tmp_path, monkeypatch):
    pytest.importorskip("wandb", reason="the extra wandb is not installed")
    monkeypatch.delenv("WANDB_MODE", raising=False)
    log = WandbLog(tmp_path)
    log.write({"decisions": 100, "loss": 0.5})
    log.write({"decisions": 100, "evaluation/mean_reward": 2.0})
    log.close()
    (stored,) = tmp_path.glob("wandb/offline-run-*/*.wandb")
    assert b"evaluation/mean_reward" in stored.read_bytes()


# --- the choice


def test_the_option_chooses_the_logs(fake, tmp_path):
    pytest.importorskip("tensorboard", reason="the extra tensorboard is not installed")
    assert make_logs(LoggerConfig(), tmp_path) == []
    (board,) = make_logs(LoggerConfig(kind="tensorboard"), tmp_path)
    assert isinstance(board, TensorBoardLog)
    board.close()
    assert any((tmp_path / "tensorboard").iterdir())
    (wandb,) = make_logs(LoggerConfig(kind="wandb", project="mine"), tmp_path, {"seed": 1})
    assert isinstance(wandb, WandbLog)
    assert (fake.options["project"], fake.options["config"]) == ("mine", {"seed": 1})


def test_an_unknown_logger_is_refused():
    with pytest.raises(UserError, match=r"logger.kind=mlflow.*csv, tensorboard, wandb"):
        LoggerConfig(kind="mlflow")


# --- progress


def test_figures_stay_in_sight_when_no_episode_ends_in_an_interval():
    stream = io.StringIO()
    progress = Progress(300, stream=stream)
    progress.write({"decisions": 100, "decisions_per_s": 50.0, "mean_return": 12.0, "crash_rate": 0.5})
    progress.write({"decisions": 200, "decisions_per_s": 100.0})
    second = stream.getvalue().splitlines()[1]
    assert second == "200 of 300 decisions, 100/s, 0:00:01 left, return 12.0, crashes 50.0%"


def test_the_bar_shows_rate_time_left_return_and_crashes():
    stream = io.StringIO()
    stream.isatty = lambda: True
    progress = Progress(100_000, stream=stream)
    progress.advance(10_000)
    progress.write({"decisions": 10_000, "mean_return": 3.0, "crash_rate": 0.25})
    progress.close()
    last = stream.getvalue().splitlines()[-1].rpartition("\r")[2]
    assert "10.0k/100k decisions" in last
    assert "/s, " in last
    assert " left, return 3.0, crashes 25.0%" in last


# --- Q-values against realised returns


def step(reward, done, value=None):
    rows = len(reward)
    after = {"reward": torch.tensor(reward)[:, None], "done": torch.tensor(done)[:, None]}
    told = {} if value is None else {"chosen_action_value": torch.tensor(value)[:, None]}
    return TensorDict({"action": torch.zeros(rows, dtype=torch.int64), "next": after, **told}, [rows])


def test_the_return_to_go_is_averaged_over_the_decisions_of_finished_episodes():
    meter = Meter(2, 2, gamma=0.5)
    meter.step(step([1.0, 9.0], [False, False], [2.0, 0.0]))
    meter.step(step([2.0, 9.0], [False, False], [4.0, 0.0]))
    meter.step(step([4.0, 9.0], [True, False], [6.0, 0.0]))
    row = meter.read()
    # From the three decisions: 1 + 2/2 + 4/4, 2 + 4/2, 4.
    assert row["mean_return_to_go"] == pytest.approx((3.0 + 4.0 + 4.0) / 3.0)
    assert row["mean_value"] == pytest.approx(4.0)


def test_the_return_to_go_agrees_with_a_sum_over_every_decision():
    generator, gamma, rows = torch.Generator().manual_seed(0), 0.9, 5
    rewards = torch.randn(60, rows, generator=generator)
    ends = torch.rand(60, rows, generator=generator) < 0.15
    meter, total, count = Meter(rows, 2, gamma), 0.0, 0
    for reward, done in zip(rewards, ends):
        meter.step(step(reward.tolist(), done.tolist()))
    for row in range(rows):
        begin = 0
        for end in ends[:, row].nonzero().flatten().tolist():
            episode = rewards[begin : end + 1, row].tolist()
            total += sum(gamma**i * r for start in range(len(episode)) for i, r in enumerate(episode[start:]))
            count, begin = count + len(episode), end + 1
    assert meter.read()["mean_return_to_go"] == pytest.approx(total / count, rel=1e-5)


def test_a_policy_that_does_not_tell_its_values_leaves_their_column_empty():
    meter = Meter(1, 2, gamma=0.5)
    meter.step(step([1.0], [True]))
    assert "mean_value" not in meter.read()


def test_the_metrics_have_a_column_for_every_early_diagnostic():
    wanted = {"mean_q", "mean_value", "mean_return_to_go", "mean_discounted_return", "sigma", "priority"}
    assert wanted <= set(COLUMNS)
