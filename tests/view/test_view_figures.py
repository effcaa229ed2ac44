"""The common style: rows of panels, legends, and files that come whole in their format."""

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from reference.refusals import user_error

from ganlane.view.figures import panel_grid, plot_line, save_figure


def chart():
    figure, (axes,) = panel_grid(1)
    axes.set(title="a chart")
    plot_line(axes, [0, 1], [2, 3])
    return figure


def test_a_value_between_gaps_is_a_dot_and_no_other_is():
    axes = Figure().subplots()
    plot_line(axes, range(7), [1.0, np.nan, 2.0, np.nan, 3.0, 4.0, 5.0])
    (line,) = axes.lines
    assert np.flatnonzero(line.get_markevery()).tolist() == [0, 2]


@pytest.mark.parametrize(
    ("ending", "begins"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")]
)
def test_the_ending_chooses_the_format_and_the_same_figure_gives_the_same_file(
    tmp_path, ending, begins
):
    first, again = (save_figure(chart(), tmp_path / f"{name}.{ending}") for name in ("a", "b"))
    assert first.read_bytes().startswith(begins)
    assert first.read_bytes() == again.read_bytes()


def test_a_figure_is_written_whole_or_not_at_all(tmp_path):
    with Image.open(save_figure(panel_grid(4)[0], tmp_path / "chart.png")) as picture:
        assert picture.size == (3 * 480, 2 * 276 + 36)
    with user_error("png, svg, pdf"):
        save_figure(Figure(), tmp_path / "chart.jpg")
    assert list(tmp_path.iterdir()) == [tmp_path / "chart.png"]


def test_a_program_s_own_matplotlib_settings_stay(tmp_path):
    with matplotlib.rc_context():
        before = dict(matplotlib.rcParams)
        save_figure(chart(), tmp_path / "chart.svg")
        assert dict(matplotlib.rcParams) == before
