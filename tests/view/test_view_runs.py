"""Figures of training runs, read from their folders: what is read, what the runs are called."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from view_scenes import run_folder

from ganlane.errors import UserError
from ganlane.view import read_metrics, read_run, read_runs
from ganlane.view.runs import run_names, running_mean


def test_a_runs_evaluations_are_merged_with_its_metrics(tmp_path):
    frame = read_run(run_folder(tmp_path / "run"))
    assert frame.height == 33
    assert frame["evaluation_mean_reward"].drop_nulls().to_list() == [1.0, 3.0, 2.0]
    assert frame.filter(pl.col("evaluation_crash_rate").is_not_null())["decisions"].to_list() == [
        100_000,
        200_000,
        300_000,
    ]
    assert read_run(run_folder(tmp_path / "other", evaluated=False)).height == 30


def test_runs_are_called_by_the_shortest_ends_that_tell_them_apart(tmp_path):
    for name in ("x/one", "x/two", "y/one"):
        run_folder(tmp_path / name)
    assert run_names([tmp_path / "x/one", tmp_path / "x/two"]) == ["one", "two"]
    assert run_names([tmp_path / "x/one", tmp_path / "y/one"]) == ["x/one", "y/one"]
    assert run_names([tmp_path / "x/one/metrics.csv"]) == ["one"]
    assert list(read_runs([tmp_path / "y/one", tmp_path / "x/two"])) == ["one", "two"]
    with pytest.raises(UserError, match="twice"):
        run_names([tmp_path / "x/one", tmp_path / "x/one"])


def test_the_running_mean_skips_gaps():
    values = np.array([1.0, 3.0, np.nan, 5.0, 9.0])
    assert running_mean(values, 2) == pytest.approx([1.0, 2.0, np.nan, 5.0, 7.0], nan_ok=True)


def test_what_is_no_metrics_file_is_named(tmp_path):
    with pytest.raises(UserError, match="no such file"):
        read_metrics(tmp_path)
    (tmp_path / "metrics.csv").write_text("step,loss\n1,2\n")
    with pytest.raises(UserError, match="decisions"):
        read_metrics(tmp_path)
    (tmp_path / "metrics.csv").write_bytes(b"\xff\xfe\x00broken")
    with pytest.raises(UserError, match=r"metrics\.csv"):
        read_metrics(tmp_path)
