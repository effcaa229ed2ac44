"""CSV files, the progress, TensorBoard, and Weights & Biases."""

import io
import re
import sys
from unittest.mock import MagicMock

import pytest
from reference.refusals import user_error

from ganlane.settings.train import LoggerConfig
from ganlane.training.logs import CsvLog, Progress, TensorBoardLog, WandbLog, make_logs, read_rows

# --- CSV


@pytest.fixture
def path(tmp_path):
    return tmp_path / "metrics.csv"


def written(path, columns, rows, **options):
    """The file at ``path``, with these rows written to it."""
    log = CsvLog(path, columns, **options)
    for row in rows:
        log.write(row)
    log.close()
    return path


def test_a_resumed_log_forgets_the_rows_after_the_checkpoint(path):
    columns = ["decisions", "loss"]
    rows = [{"decisions": n, "loss": 1.0 / 3.0, "unknown": 5.0} for n in (100, 200, 300)]
    written(path, columns, rows)
    written(path, columns, [{"decisions": 260}], decisions=200)
    assert path.read_text() == "decisions,loss\n100,0.333333\n200,0.333333\n260,\n"


def test_a_log_torn_at_any_byte_holds_its_whole_rows_and_no_other(path):
    columns = ["loss", "decisions"]  # the last column is the one that can be cut unseen
    rows = [{"loss": "0.5", "decisions": n} for n in ("100000", "200000", "300000")]
    whole = written(path, columns, rows).read_bytes()
    for size in range(len(whole) + 1):
        path.write_bytes(whole[:size])
        complete = max(0, whole[:size].count(b"\n") - 1)
        assert read_rows(path) == rows[:complete]
        written(path, columns, [], decisions=250_000)
        assert read_rows(path) == rows[: min(complete, 2)]


@pytest.mark.parametrize("torn", ["20", "20,0.", "20,0.5,1,30,0.5,1", "20,0.530,0.5,1"])
def test_a_row_of_too_few_or_too_many_columns_is_left_out(path, torn):
    path.write_text(f"decisions,loss,sigma\n10,0.5,1\n{torn}\n40,0.5,\n")
    assert [row["decisions"] for row in read_rows(path)] == ["10", "40"]


@pytest.mark.parametrize(
    "content",
    [
        b"decisions,loss\nmany,0.5\n",
        b"decisions,loss\n10,half\n",
        b"decisions,loss\nnan,0.5\n",
        b"loss,sigma\n10,0.5\n",
        b"\xff\xfe\x00\n",
        b"decisions,loss\n" + b"1" * 200_000 + b",1\n",
        b"decisions,loss\n10,\x00\n",
    ],
    ids=lambda content: str(content[:24]),
)
def test_a_log_that_is_none_is_refused_in_one_sentence(content, path):
    path.write_bytes(content)
    with user_error(r"metrics\.csv: damaged \(.*\); repair it, or move it away"):
        CsvLog(path, ["decisions", "loss"])
    assert path.read_bytes() == content


# --- progress


def test_progress_off_a_terminal_is_a_line_per_row_with_the_last_known_figures(capsys):
    progress = Progress(1_000_000)
    progress.advance(5)
    outcome = {"mean_return": 12.34, "crash_rate": 0.125}
    progress.write({"decisions": 100_000, "decisions_per_s": 5000.0, **outcome})
    progress.write({"decisions": 200_000, "decisions_per_s": 10_000.0})
    progress.write({"decisions": 962_766, "decisions_per_s": 10.0})
    assert capsys.readouterr().err.splitlines() == [
        "100,000 of 1,000,000 decisions, 5,000/s, 0:03:00 left, return 12.3, crashes 12.5%",
        "200,000 of 1,000,000 decisions, 10,000/s, 0:01:20 left, return 12.3, crashes 12.5%",
        "962,766 of 1,000,000 decisions, 10/s, 1:02:03 left, return 12.3, crashes 12.5%",
    ]


def test_progress_on_a_terminal_is_a_bar_with_rate_time_left_return_and_crashes(monkeypatch):
    stream = io.StringIO()
    stream.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", stream)
    progress = Progress(100_000)
    progress.advance(10_000)
    progress.write({"decisions": 10_000, "mean_return": 3.0, "crash_rate": 0.25})
    progress.close()
    last = stream.getvalue().splitlines()[-1].rpartition("\r")[2]
    assert re.search("10.0k/100k decisions.*/s, .* left, return 3.0, crashes 25.0%", last)


# --- TensorBoard, Weights & Biases


@pytest.fixture
def fake(monkeypatch):
    """A wandb that remembers what it was given; no process, no network."""
    module = MagicMock(Error=type("Error", (Exception,), {}))
    monkeypatch.setitem(sys.modules, "wandb", module)
    monkeypatch.delenv("WANDB_MODE", raising=False)
    return module


def test_wandb_is_offline_unless_told_gets_every_figure_over_the_decisions_and_is_finished(
    fake, tmp_path, monkeypatch
):
    log = WandbLog(tmp_path)
    assert fake.init.call_args.kwargs["mode"] == "offline"
    log.write({"decisions": 100, "loss": 0.5, "mean_return": 3.0})
    log.close()
    fake.init.return_value.log.assert_called_once_with({"loss": 0.5, "mean_return": 3.0}, step=100)
    fake.init.return_value.finish.assert_called_once()
    monkeypatch.setenv("WANDB_MODE", "online")
    WandbLog(tmp_path)
    assert fake.init.call_args.kwargs["mode"] == "online"


@pytest.mark.parametrize(
    ("log", "module", "extra"),
    [(WandbLog, "wandb", "wandb"), (TensorBoardLog, "torch.utils.tensorboard", "tensorboard")],
)
def test_a_missing_package_is_named_with_the_command_that_mends_it(
    log, module, extra, tmp_path, monkeypatch
):
    monkeypatch.setitem(sys.modules, module, None)
    with user_error(rf"pip install 'ganlane\[{extra}\]'.*logger=csv\.$"):
        log(tmp_path)


def test_a_wandb_that_does_not_start_is_one_sentence(fake, tmp_path, monkeypatch):
    fake.init.side_effect = fake.Error("api_key not configured")
    monkeypatch.setenv("WANDB_MODE", "online")
    with user_error(r"WANDB_MODE=online.*api_key not configured.*WANDB_MODE=offline"):
        WandbLog(tmp_path)


def test_the_option_chooses_the_logs(fake, tmp_path):
    pytest.importorskip("tensorboard", reason="the extra tensorboard is not installed")
    assert make_logs(LoggerConfig(), tmp_path) == []
    (board,) = make_logs(LoggerConfig(kind="tensorboard"), tmp_path)
    assert isinstance(board, TensorBoardLog)
    board.write({"decisions": 100, "loss": 0.5})
    board.close()
    assert any(path.name.startswith("events") for path in (tmp_path / "tensorboard").iterdir())
    (wandb,) = make_logs(LoggerConfig(kind="wandb", project="mine"), tmp_path)
    assert isinstance(wandb, WandbLog)
    assert fake.init.call_args.kwargs["project"] == "mine"
