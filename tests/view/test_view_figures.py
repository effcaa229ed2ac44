"""Charts.

What is drawn is the data, with its names and units, and files come whole in the format of their
ending.
"""

from __future__ import annotations

import matplotlib
import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from PIL import Image
from view_scenes import run_folder

from ganlane.config.run import as_yaml
from ganlane.data import (
    Bins,
    Histogram,
    PooledStatistics,
    Scene,
    SyntheticTraffic,
    synthetic_scenes,
)
from ganlane.errors import UserError
from ganlane.settings.record import make
from ganlane.settings.train import TrainConfig
from ganlane.view.figures import (
    COLOURS,
    add_legend,
    binned_density,
    draw_recordings,
    draw_runs,
    palette,
    panel_grid,
    plot_line,
    read_run,
    read_runs,
    running_mean,
    save_figure,
)


def panels(figure):
    return {axes.get_title("left"): axes for axes in figure.axes}


def words(texts):
    return [text.get_text() for text in texts]


@pytest.fixture
def runs(tmp_path):
    first = read_run(run_folder(tmp_path / "a"))
    return {"a": first, "b": read_run(run_folder(tmp_path / "b", slope=2.0, evaluated=False))}


def test_a_line_is_the_metric_over_the_decisions(runs):
    (line,) = panels(draw_runs({"a": runs["a"]}))["crash rate"].lines
    assert line.get_xdata().tolist() == [10_000 * k for k in range(1, 31)]
    assert line.get_ydata() == pytest.approx(0.5 - 0.01 * np.arange(30))


def test_every_panel_shows_every_run_that_has_its_numbers_in_the_run_s_colour(runs):
    figure = draw_runs(runs)
    drawn = {
        title: [to_hex(line.get_color()) for line in axes.lines]
        for title, axes in panels(figure).items()
    }
    assert words(figure.legends[0].get_texts()) == ["a", "b"]
    a, b, *_ = COLOURS
    assert drawn == {
        **{title: [a, b] for title in ("mean return", "crash rate", "lane changes")},
        "mean Q (replayed); dashed: discounted return": [a, a, b, b],
        **{title: [a] for title in ("evaluation: mean return", "evaluation: crash rate")},
    }
    # Axes say what they measure.
    drawn = panels(figure)
    assert {axes.get_xlabel() for axes in drawn.values()} == {"decisions"}
    assert drawn["lane changes"].get_ylabel() == "per km"
    assert drawn["evaluation: crash rate"].get_ylabel() == "share of episodes"
    assert drawn["crash rate"].xaxis.get_major_formatter()(250_000) == "250 k"


def test_the_discounted_return_is_dashed_below_the_q_values(runs):
    axes = panels(draw_runs({"a": runs["a"]}))["mean Q (replayed); dashed: discounted return"]
    assert [line.get_linestyle() for line in axes.lines] == ["-", "--"]
    # the first three rows have no Q-value
    assert axes.lines[0].get_ydata()[0] == pytest.approx(0.3)
    assert len(axes.lines[0].get_xdata()) == 27


def test_a_smoothed_line_is_drawn_over_its_values(runs):
    raw, smooth = panels(draw_runs({"a": runs["a"]}, smooth=5))["mean return"].lines
    assert raw.get_ydata() == pytest.approx(np.arange(1.0, 31.0))
    assert raw.get_alpha() < 1.0
    assert smooth.get_ydata()[4:] == pytest.approx(np.arange(3.0, 29.0))


def test_columns_of_ones_choice_take_the_place_of_the_panels_and_unknown_ones_are_named(runs):
    assert list(panels(draw_runs(runs, ["loss", "evaluation_mean_reward"]))) == [
        "loss",
        "evaluation mean reward",
    ]
    with pytest.raises(UserError, match=r"column nothing: .* choose among mean_return, crash_rate"):
        draw_runs(runs, ["nothing"])
    with pytest.raises(UserError, match="foreign: no numbers"):
        draw_runs({"foreign": pl.DataFrame({"decisions": [1], "name": ["a"]})})


def test_a_value_between_gaps_is_a_dot_and_no_other_is():
    axes = Figure().subplots()
    plot_line(axes, range(7), [1.0, np.nan, 2.0, np.nan, 3.0, 4.0, 5.0])
    (line,) = axes.lines
    assert np.isnan(line.get_ydata()).tolist() == [False, True, False, True, False, False, False]
    assert np.flatnonzero(line.get_markevery()).tolist() == [0, 2]


def test_long_names_share_the_legend_over_several_rows():
    for length, rows in ((3, 1), (40, 4)):
        figure = Figure(figsize=(4.0, 3.0))
        add_legend(figure, palette([f"{k}".rjust(length, "x") for k in range(4)]))
        assert -(-4 // figure.legends[0]._ncols) == rows


@settings(max_examples=30)
@given(
    st.lists(st.floats(0.0, 9.99), min_size=1, max_size=200), st.sampled_from([10, 80, 400, 8000])
)
def test_the_area_below_a_density_is_one(values, bins):
    histogram = Histogram(Bins(0.0, 10.0, bins))
    histogram.add(values)
    middles, density = binned_density(histogram, 0.0, 10.0)
    assert float(np.sum(density)) * float(middles[1] - middles[0]) == pytest.approx(1.0)
    assert middles[0] > 0.0
    assert middles[-1] < 10.0


def measured(**traffic):
    statistics = PooledStatistics()
    for (name,), scene in synthetic_scenes(SyntheticTraffic(**traffic)).group_by("scene"):
        statistics.add(Scene(name, scene, 3.5))
    return statistics


def test_recordings_are_drawn_in_six_panels_with_their_units():
    drawn = panels(draw_recordings(measured(lanes=1, seconds=3.0)))
    times = (
        "time to change lanes",
        "followers' headway: median (gap - 2 m) / speed",
        "time headway: gap / speed",
    )
    units = {
        "speed": "m/s",
        "acceleration": "m/s²",
        **dict.fromkeys(times, "s"),
        "gap to the leader": "m",
    }
    assert {title: axes.get_xlabel() for title, axes in drawn.items()} == units
    assert words(drawn.pop("time to change lanes").texts) == ["none recorded from start to end"]
    assert all(line.get_ydata().sum() > 0 for axes in drawn.values() for line in axes.lines)
    assert words(drawn["acceleration"].get_legend().get_texts()) == ["as recorded", "over 1 s"]


def test_lane_changes_are_drawn_as_the_share_that_lasts_longer():
    statistics = measured()
    assert statistics.changes.complete.sum() == 3
    for line in panels(draw_recordings(statistics))["time to change lanes"].lines:
        times, shares = line.get_xdata(), line.get_ydata()
        assert line.get_drawstyle() == "steps-post"
        assert times.tolist() == [0.0, *np.unique(statistics.changes.duration_s)]
        assert shares == pytest.approx(
            [(statistics.changes.duration_s > time).mean() for time in times]
        )


@pytest.mark.parametrize(
    ("ending", "begins"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")]
)
def test_the_ending_chooses_the_format_and_the_same_figure_gives_the_same_file(
    runs, tmp_path, ending, begins
):
    first, again = (
        save_figure(draw_runs(runs, ["loss"]), tmp_path / f"{name}.{ending}") for name in ("a", "b")
    )
    assert first.read_bytes().startswith(begins)
    assert first.read_bytes() == again.read_bytes()


def test_a_figure_is_written_whole_or_not_at_all(runs, tmp_path):
    before = set(tmp_path.iterdir())
    with Image.open(save_figure(draw_runs(runs), tmp_path / "curves.png")) as picture:
        assert picture.size == (3 * 480, 2 * 276 + 36)
    with pytest.raises(UserError, match="png, svg, pdf"):
        save_figure(Figure(), tmp_path / "curves.jpg")
    assert set(tmp_path.iterdir()) - before == {tmp_path / "curves.png"}


def test_a_program_s_own_matplotlib_settings_stay(runs, tmp_path):
    with matplotlib.rc_context():
        own = dict(matplotlib.rcParams)
        save_figure(draw_runs(runs, ["loss"]), tmp_path / "curves.svg")
        assert dict(matplotlib.rcParams) == own


def test_a_runs_evaluations_are_merged_with_its_metrics(runs):
    frame = runs["a"]
    assert frame.height == 33
    evaluated = frame.drop_nulls("evaluation_crash_rate")
    assert evaluated["decisions"].to_list() == [100_000, 200_000, 300_000]
    assert evaluated["evaluation_mean_reward"].to_list() == [1.0, 3.0, 2.0]
    assert runs["b"].height == 30


def test_runs_are_called_by_the_shortest_ends_that_tell_them_apart(tmp_path):
    one, two, other = (run_folder(tmp_path / name) for name in ("x/one", "x/two", "y/one"))
    assert list(read_runs([one, two])) == list(read_runs([other, two])) == ["one", "two"]
    assert list(read_runs([one, other])) == ["x/one", "y/one"]
    assert list(read_runs([one / "metrics.csv"])) == ["one"]
    with pytest.raises(UserError, match="twice"):
        read_runs([one, one])


def sweep_folder(folder, *settings):
    for number, data in enumerate(settings):
        run = run_folder(folder / str(number), slope=1.0 + number, evaluated=False)
        (run / "config.yaml").write_text(as_yaml(make(TrainConfig, data)))
    return folder


def test_the_runs_of_a_sweep_are_named_by_the_options_in_which_they_differ(tmp_path):
    gan = {"traffic": "gan"}
    folder = sweep_folder(tmp_path, {**gan, "agent": {"n_step": 1}}, gan, {"traffic": "idm"})
    assert list(read_runs([folder])) == [
        "agent.n_step=1, traffic=gan",
        "agent.n_step=3, traffic=gan",
        "agent.n_step=3, traffic=idm",
    ]


def test_seeds_are_drawn_as_their_mean_in_a_band(tmp_path):
    settings = [{"traffic": name, "seed": seed} for name in ("gan", "idm") for seed in (0, 1)]
    runs = read_runs([sweep_folder(tmp_path, *settings)])
    assert {name: len(frames) for name, frames in runs.items()} == {
        "traffic=gan": 2,
        "traffic=idm": 2,
    }
    figure = draw_runs(runs)
    assert words(figure.legends[0].get_texts())[0] == "traffic=gan (2 seeds: mean, range)"
    axes = panels(figure)["mean return"]
    assert axes.lines[0].get_ydata() == pytest.approx(1.5 * np.arange(1.0, 31.0))
    assert axes.collections[0].get_paths()[0].vertices[:, 1].max() == pytest.approx(60.0)
    same = sweep_folder(tmp_path / "same", *settings[:2])
    assert list(read_runs([same])) == ["all seeds"]


def test_no_panel_is_alone_in_its_row():
    for count in (1, 2, 3, 4, 5, 7, 10, 13):
        figure, grid = panel_grid(count)
        rows = [axes.get_subplotspec().rowspan.start for axes in grid]
        assert len(grid) == len(figure.axes) == count
        assert count in (1, 2, 3) or min(rows.count(row) for row in rows) > 1


def test_the_running_mean_skips_gaps():
    values = np.array([1.0, 3.0, np.nan, 5.0, 9.0])
    assert running_mean(values, 2) == pytest.approx([1.0, 2.0, np.nan, 5.0, 7.0], nan_ok=True)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no such file"),
        (b"step,loss\n1,2\n", "decisions"),
        (b"\xff\xfe\x00broken", r"metrics\.csv"),
        *(
            (
                b"decisions,mean_return\n5,2\n" + row,
                r"metrics\.csv: column '.*' holds .*; repair it\.",
            )
            for row in (b"many,1\n", b"10,text\n", b"10,1e300\n")
        ),
    ],
)
def test_what_is_no_metrics_file_is_named(content, message, tmp_path):
    if content is not None:
        (tmp_path / "metrics.csv").write_bytes(content)
    with pytest.raises(UserError, match=message):
        read_run(tmp_path)
