"""Several training runs in one picture: their panels, their colours, their names."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from PIL import Image

from ganlane.errors import UserError
from ganlane.view import draw_runs, read_run, write_runs
from ganlane.view.plot import LINES, Line, Panel
from ganlane.view.runs import run_names

PANEL, LEGEND = (480, 260), 34


def run_folder(folder, slope=1.0, evaluated=True):
    """The files that training leaves: some columns empty in the first rows."""
    folder.mkdir(parents=True)
    x = np.arange(1, 31) * 10_000
    learnt = [None if k < 3 else 0.1 * slope * k for k in range(30)]
    columns = {"mean_return": slope * x / 1e4, "crash_rate": (0.5 - 0.01 * np.arange(30)) * slope}
    more = {"lane_changes_per_km": slope + 0.0 * x, "mean_q": learnt, "mean_discounted_return": 2.0 * slope + 0.0 * x}
    pl.DataFrame({"decisions": x, **columns, **more, "loss": learnt}).write_csv(folder / "metrics.csv")
    if evaluated:
        rows = {"decisions": x[9::10], "mean_reward": [1.0, 3.0, 2.0], "crash_rate": [0.3, 0.2, 0.1]}
        pl.DataFrame(rows).write_csv(folder / "evaluation.csv")
    return folder


def panel(sheet, index):
    """One panel of a sheet, three in a row."""
    left, top = index % 3 * PANEL[0], index // 3 * PANEL[1] + LEGEND
    return np.asarray(sheet.crop((left, top, left + PANEL[0], top + PANEL[1]))).astype(int)


def ink(pixels, colour):
    return int((np.abs(pixels - colour).max(axis=-1) < 8).sum())


def test_a_runs_evaluations_stand_below_its_metrics(tmp_path):
    frame = read_run(run_folder(tmp_path / "run"))
    assert frame.height == 33
    assert frame["evaluation_mean_reward"].drop_nulls().to_list() == [1.0, 3.0, 2.0]
    assert frame.filter(pl.col("evaluation_crash_rate").is_not_null())["decisions"].to_list() == [
        100_000,
        200_000,
        300_000,
    ]
    assert read_run(run_folder(tmp_path / "other", evaluated=False)).height == 30


def test_every_panel_shows_every_run_that_has_its_numbers(tmp_path):
    runs = {
        "a": read_run(run_folder(tmp_path / "a")),
        "b": read_run(run_folder(tmp_path / "b", slope=2.0, evaluated=False)),
    }
    sheet = draw_runs(runs)
    assert sheet.size == (3 * PANEL[0], 2 * PANEL[1] + LEGEND)
    for index in range(6):
        assert ink(panel(sheet, index), LINES[0]) > 100, index
        assert (ink(panel(sheet, index), LINES[1]) > 100) == (index < 4), index


def test_columns_of_ones_choice_take_the_place_of_the_panels(tmp_path):
    runs = {"a": read_run(run_folder(tmp_path / "a"))}
    assert draw_runs(runs, ["loss", "evaluation_mean_reward"]).size == (2 * PANEL[0], PANEL[1] + LEGEND)
    with pytest.raises(UserError, match="column nothing"):
        draw_runs(runs, ["nothing"])


def test_a_dashed_line_is_drawn_by_half():
    x = np.linspace(0.0, 1.0, 50)
    inked = [
        ink(np.asarray(Panel("", [Line(x, 0.5 * x, dashed=dashed)], *PANEL).draw()).astype(int), LINES[0])
        for dashed in (False, True)
    ]
    assert inked[1] == pytest.approx(0.5 * inked[0], rel=0.15)


def test_runs_are_called_by_the_shortest_ends_that_tell_them_apart(tmp_path):
    for name in ("x/one", "x/two", "y/one"):
        run_folder(tmp_path / name)
    assert run_names([tmp_path / "x/one", tmp_path / "x/two"]) == ["one", "two"]
    assert run_names([tmp_path / "x/one", tmp_path / "y/one"]) == ["x/one", "y/one"]
    assert run_names([tmp_path / "x/one/metrics.csv"]) == ["one"]
    with pytest.raises(UserError, match="twice"):
        run_names([tmp_path / "x/one", tmp_path / "x/one"])


def test_a_picture_is_written_whole_or_not_at_all(tmp_path):
    path = write_runs([run_folder(tmp_path / "run")], tmp_path / "curves.png", smooth=5)
    with Image.open(path) as picture:
        assert picture.size == (3 * PANEL[0], 2 * PANEL[1] + LEGEND)
    with pytest.raises(UserError, match=r"nowhere.*no such file"):
        write_runs([tmp_path / "nowhere"], tmp_path / "none.png")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "metrics.csv").write_text("decisions,name\n1,a\n")
    with pytest.raises(UserError, match="foreign: no numbers"):
        write_runs([tmp_path / "foreign"], tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()
