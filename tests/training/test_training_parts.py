"""Meter, logs, progress and checkpoint files."""

import csv
import io
import sys

import pytest
import torch
from tensordict import TensorDict

from ganlane.errors import UserError
from ganlane.training.checkpoint import load_checkpoint, save_checkpoint
from ganlane.training.collectors import pack, unpack
from ganlane.training.logs import CsvLog, Progress, TensorBoardLog, duration, read_rows
from ganlane.training.loop import TrainingConfig
from ganlane.training.stats import EpisodeStats


def step(reward, done, crash=None, goal=None, distance=0.0, lane_changes=0, action=0):
    rows = len(reward)

    def column(flags):
        return torch.tensor(flags or [False] * rows)[:, None]

    after = {
        "reward": torch.tensor(reward)[:, None],
        "done": column(done),
        "events": {"goal": column(goal), "hard_crash": column(crash)},
        "ego": {"distance": torch.full((rows,), distance), "lane_changes": torch.full((rows,), lane_changes)},
    }
    return TensorDict({"action": torch.full((rows,), action), "next": after}, [rows])


# --- meter


def test_returns_and_rates_are_those_of_the_finished_episodes():
    meter = EpisodeStats(2, 3, gamma=0.5)
    meter.step(step([1.0, 10.0], [False, False], distance=500.0))
    meter.step(step([2.0, 20.0], [True, False], crash=[True, False], distance=1000.0, lane_changes=3, action=2))
    meter.step(step([4.0, 40.0], [True, True], goal=[False, True], distance=1000.0, lane_changes=1))
    row = meter.read()
    assert row["episodes"] == 3
    assert row["mean_return"] == pytest.approx((3 + 4 + 70) / 3)
    assert row["mean_discounted_return"] == pytest.approx((1 + 1 + 4 + 10 + 10 + 10) / 3)
    assert row["crash_rate"] == pytest.approx(1 / 3)
    assert row["goal_rate"] == pytest.approx(1 / 3)
    assert row["lane_changes_per_km"] == pytest.approx(5 / 3)
    assert row["action_2_share"] == pytest.approx(1 / 3)


def test_an_interval_starts_afresh_but_a_running_episode_goes_on():
    meter = EpisodeStats(1, 3, gamma=1.0)
    meter.step(step([5.0], [False]))
    assert "mean_return" not in meter.read()
    meter.step(step([2.0], [True]))
    assert meter.read()["mean_return"] == 7.0


def test_update_figures_are_averaged():
    meter = EpisodeStats(1, 3, gamma=1.0)
    for value in (1.0, 2.0, 6.0):
        meter.update({"loss": torch.tensor(value)})
    assert meter.read()["loss"] == pytest.approx(3.0)
    assert "loss" not in meter.read()


def test_environments_without_events_are_metered_too():
    meter = EpisodeStats(1, 2, gamma=1.0)
    after = {"reward": torch.ones(1, 1), "done": torch.ones(1, 1, dtype=torch.bool)}
    meter.step(TensorDict({"action": torch.zeros(1, dtype=torch.int64), "next": after}, [1]))
    assert set(meter.read()) == {
        "episodes",
        "mean_return",
        "mean_discounted_return",
        "mean_return_to_go",
        "action_0_share",
        "action_1_share",
    }


# --- logs


def test_a_resumed_log_forgets_the_rows_after_the_checkpoint(tmp_path):
    path = tmp_path / "metrics.csv"
    first = CsvLog(path, ["decisions", "loss"])
    for decisions in (100, 200, 300):
        first.write({"decisions": decisions, "loss": 1.0 / 3.0, "unknown": 5.0})
    first.close()
    second = CsvLog(path, ["decisions", "loss"], decisions=200)
    second.write({"decisions": 260})
    second.close()
    with path.open() as file:
        found = list(csv.reader(file))
    assert found == [["decisions", "loss"], ["100", "0.333333"], ["200", "0.333333"], ["260", ""]]


def test_a_log_torn_at_any_byte_holds_its_whole_rows_and_no_other(tmp_path):
    path = tmp_path / "metrics.csv"
    log = CsvLog(path, ["loss", "decisions"])  # the last column is the one that can be cut unseen
    rows = [{"loss": "0.5", "decisions": str(decisions)} for decisions in (100_000, 200_000, 300_000)]
    for row in rows:
        log.write(row)
    log.close()
    whole = path.read_bytes()
    for size in range(len(whole) + 1):
        path.write_bytes(whole[:size])
        complete = max(0, whole[:size].count(b"\n") - 1)
        assert read_rows(path) == rows[:complete]
        CsvLog(path, ["loss", "decisions"], decisions=250_000).close()
        assert read_rows(path) == rows[: min(complete, 2)]


@pytest.mark.parametrize("torn", ["20", "20,0.", "20,0.5,1,30,0.5,1", "20,0.530,0.5,1"])
def test_a_row_of_too_few_or_too_many_columns_is_left_out(tmp_path, torn):
    path = tmp_path / "metrics.csv"
    path.write_text(f"decisions,loss,sigma\n10,0.5,1\n{torn}\n40,0.5,\n")
    assert [row["decisions"] for row in read_rows(path)] == ["10", "40"]


def test_progress_off_a_terminal_is_a_line_per_row():
    stream = io.StringIO()
    progress = Progress(1_000_000, stream=stream)
    progress.advance(5)
    progress.write({"decisions": 100_000, "decisions_per_s": 5000.0, "mean_return": 12.34, "crash_rate": 0.125})
    assert stream.getvalue() == "100,000 of 1,000,000 decisions, 5,000/s, 0:03:00 left, return 12.3, crashes 12.5%\n"


def test_progress_on_a_terminal_is_a_bar():
    stream = io.StringIO()
    stream.isatty = lambda: True
    progress = Progress(1000, stream=stream)
    progress.advance(500)
    progress.write({"decisions": 500, "mean_return": 3.0})
    progress.close()
    assert "50%" in stream.getvalue()
    assert "return 3.0" in stream.getvalue()


def test_durations_are_read_as_hours_minutes_seconds():
    assert duration(3723.4) == "1:02:03"


def test_tensorboard_gets_every_figure(tmp_path):
    pytest.importorskip("tensorboard")
    log = TensorBoardLog(tmp_path)
    log.write({"decisions": 100, "loss": 0.5})
    log.close()
    assert any(path.name.startswith("events") for path in tmp_path.iterdir())


def test_a_missing_tensorboard_is_named_with_the_command_that_mends_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(UserError, match=r"pip install 'ganlane\[tensorboard\]'"):
        TensorBoardLog(tmp_path)


# --- checkpoint files


def test_a_checkpoint_comes_back_as_it_was(tmp_path):
    save_checkpoint(tmp_path / "last.pt", {"weights": torch.arange(3), "count": 4})
    state = load_checkpoint(tmp_path / "last.pt")
    assert state["count"] == 4
    assert torch.equal(state["weights"], torch.arange(3))
    assert [path.name for path in tmp_path.iterdir()] == ["last.pt"]


@pytest.mark.parametrize("cut", [0, 10, 200, 700])
def test_a_truncated_checkpoint_is_refused(cut, tmp_path):
    path = tmp_path / "last.pt"
    save_checkpoint(path, {"weights": torch.arange(1000)})
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(UserError, match="not a readable checkpoint"):
        load_checkpoint(path)


def test_foreign_files_are_refused(tmp_path):
    path = tmp_path / "other.pt"
    torch.save({"model": torch.zeros(3)}, path)
    with pytest.raises(UserError, match="not a ganlane training checkpoint"):
        load_checkpoint(path)
    path.write_text("a text file")
    with pytest.raises(UserError, match="not a readable checkpoint"):
        load_checkpoint(path)
    with pytest.raises(UserError, match="no such file"):
        load_checkpoint(tmp_path / "absent.pt")


def test_a_file_that_would_run_code_is_refused(tmp_path):
    class Sly:
        def __reduce__(self):
            return (open, (str(tmp_path / "made"), "w"))

    torch.save({"kind": "ganlane training checkpoint", "state": Sly()}, tmp_path / "sly.pt")
    with pytest.raises(UserError, match="not a readable checkpoint"):
        load_checkpoint(tmp_path / "sly.pt")
    assert not (tmp_path / "made").exists()


def test_a_tensordict_is_packed_with_its_nested_batch_sizes():
    inner = TensorDict({"a": torch.zeros(2, 3, 1)}, [2, 3])
    whole = TensorDict({"inner": inner, "b": torch.ones(2)}, [2])
    back = unpack(pack(whole))
    assert back["inner"].batch_size == (2, 3)
    assert (back == whole).all()


@pytest.mark.parametrize("options", [{"total_decisions": 0}, {"total_decisions": 1, "log_every": 0}])
def test_an_impossible_rhythm_is_refused(options):
    with pytest.raises(UserError, match="expected at least 1"):
        TrainingConfig(**options)
