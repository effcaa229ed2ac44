"""Learning curves from metrics files."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from ganlane.errors import UserError
from ganlane.view import draw_curves, read_metrics, write_curves
from ganlane.view.curves import running_mean
from ganlane.view.plot import LINES, tick_text, ticks


def metrics(rows=30, slope=1.0):
    x = np.arange(rows) * 10_000
    evaluated = [None if k % 10 else 5.0 + slope * k for k in range(rows)]
    return pl.DataFrame(
        {"decisions": x, "mean_return": slope * x / 1e4, "crash_rate": 0.2 * slope, "eval": evaluated, "note": "x"}
    )


def ink(picture, colour):
    """Where a line of this colour is."""
    return np.nonzero(np.abs(np.asarray(picture).astype(int) - colour).max(axis=-1) < 8)


def test_a_rising_metric_is_a_rising_line():
    rows, columns = ink(draw_curves({"run": metrics()}, ["mean_return"]).crop((0, 34, 480, 294)), LINES[0])
    left, right = rows[columns < 100].mean(), rows[columns > 440].mean()
    assert left > right + 100


def test_every_number_has_its_panel_and_every_run_its_colour():
    sheet = draw_curves({"a": metrics(), "b": metrics(slope=0.5)})
    assert sheet.size == (3 * 480, 260 + 34)
    for colour in LINES[:2]:
        rows, columns = ink(sheet, colour)
        assert set((columns[rows > 34] // 480).tolist()) == {0, 1, 2}


def test_a_files_curves_are_written_whole(tmp_path):
    metrics().write_csv(tmp_path / "metrics.csv")
    path = write_curves({"run": tmp_path}, tmp_path / "curves.png", smooth=5)
    with Image.open(path) as picture:
        assert picture.size[0] == 3 * 480
    assert sorted(file.name for file in tmp_path.iterdir()) == ["curves.png", "metrics.csv"]


def test_the_running_mean_skips_gaps():
    values = np.array([1.0, 3.0, np.nan, 5.0, 9.0])
    assert running_mean(values, 2) == pytest.approx([1.0, 2.0, np.nan, 5.0, 7.0], nan_ok=True)


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e7))
def test_ticks_are_few_round_and_inside(low, width):
    found = ticks(low, low + width)
    assert 1 <= len(found) <= 7
    assert found.min() >= low - 1e-6 * width
    assert found.max() <= low + width + 1e-6 * width


@pytest.mark.parametrize(
    ("value", "step", "text"),
    [(0.0, 0.05, "0"), (0.15, 0.05, "0.15"), (1.5e6, 5e5, "1.5 M"), (250_000, 50_000, "250 k"), (-20.0, 10.0, "-20")],
)
def test_tick_numbers_are_short(value, step, text):
    assert tick_text(value, step) == text


def test_mistakes_are_named(tmp_path):
    with pytest.raises(UserError, match="no such file"):
        read_metrics(tmp_path)
    (tmp_path / "metrics.csv").write_text("step,loss\n1,2\n")
    with pytest.raises(UserError, match="decisions"):
        read_metrics(tmp_path)
    (tmp_path / "metrics.csv").write_bytes(b"\xff\xfe\x00broken")
    with pytest.raises(UserError, match=r"metrics\.csv"):
        read_metrics(tmp_path)
    with pytest.raises(UserError, match="column nothing"):
        draw_curves({"run": metrics()}, ["nothing"])
    with pytest.raises(UserError, match="no numbers"):
        draw_curves({"run": metrics().select("decisions", "note")})
