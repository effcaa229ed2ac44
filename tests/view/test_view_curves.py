"""Learning curves: what is drawn is the data, with its names and units."""

import numpy as np
import polars as pl
import pytest
from matplotlib.colors import to_hex
from reference.refusals import user_error
from view_scenes import legend_of, panels, run_folder

from ganlane.view.curves import draw_runs, read_run, read_runs
from ganlane.view.figures import COLOURS


@pytest.fixture
def runs(tmp_path):
    folders = [run_folder(tmp_path / "a"), run_folder(tmp_path / "b", slope=2.0, evaluated=False)]
    return read_runs(folders)


def test_every_panel_shows_every_run_that_has_its_numbers_in_the_run_s_colour(runs):
    figure = draw_runs(runs)
    drawn = panels(figure)
    assert legend_of(figure) == ["a", "b"]
    both = ("mean return", "crash rate", "lane changes", "mean Q (replayed)", "discounted return")
    evaluated = ("evaluation: mean return", "evaluation: crash rate")
    assert drawn.keys() == {*both, *evaluated}
    for title, axes in drawn.items():
        colours = [to_hex(line.get_color()) for line in axes.lines]
        assert colours == list(COLOURS[: 2 if title in both else 1])
        # Axes say what they measure.
        assert axes.get_xlabel() == "decisions"
    assert drawn["lane changes"].get_ylabel() == "per km"
    assert drawn["evaluation: crash rate"].get_ylabel() == "share of episodes"
    assert drawn["crash rate"].xaxis.get_major_formatter()(250_000) == "250 k"


def test_a_line_is_the_metric_over_the_decisions_without_missing_values(runs):
    drawn = panels(draw_runs({"a": runs["a"]}))
    (line,) = drawn["crash rate"].lines
    assert line.get_xdata().tolist() == [10_000 * k for k in range(1, 31)]
    assert line.get_ydata() == pytest.approx(0.5 - 0.01 * np.arange(30))
    # The first three rows have no Q-value.
    (line,) = drawn["mean Q (replayed)"].lines
    assert line.get_ydata()[0] == pytest.approx(0.3)
    assert len(line.get_xdata()) == 27


def test_runs_without_numbers_are_refused():
    with user_error("foreign: no numbers"):
        draw_runs({"foreign": [pl.DataFrame({"decisions": [1], "other": [2.0]})]})


def test_runs_are_called_by_the_shortest_ends_that_tell_them_apart(tmp_path):
    one, two, other = (run_folder(tmp_path / name) for name in ("x/one", "x/two", "y/one"))
    assert list(read_runs([one, two])) == list(read_runs([other, two])) == ["one", "two"]
    assert list(read_runs([one, other])) == ["x/one", "y/one"]
    assert list(read_runs([one / "metrics.csv"])) == ["one"]
    with user_error("twice"):
        read_runs([one, one])


def sweep_folder(folder, *lines):
    for number, line in enumerate(lines):
        run = run_folder(folder / str(number), slope=1.0 + number, evaluated=False)
        (run / "config.yaml").write_text(line)
    return folder


def test_the_runs_of_a_sweep_are_named_by_the_settings_in_which_they_differ(tmp_path):
    settings = [("gan", 1), ("gan", 3), ("idm", 1)]
    lines = [f"{{traffic: {name}, agent: {{n_step: {n}}}, seed: 0}}" for name, n in settings]
    names = [f"agent.n_step={n}, traffic={name}" for name, n in settings]
    assert list(read_runs([sweep_folder(tmp_path, *lines)])) == names


def test_seeds_are_drawn_as_their_mean_in_a_band(tmp_path):
    settings = [f"{{traffic: {name}, seed: {seed}}}" for name in ("gan", "idm") for seed in (0, 1)]
    runs = read_runs([sweep_folder(tmp_path, *settings)])
    lengths = {name: len(frames) for name, frames in runs.items()}
    assert lengths == {"traffic=gan": 2, "traffic=idm": 2}
    figure = draw_runs(runs)
    assert legend_of(figure)[0] == "traffic=gan (2 seeds: mean, range)"
    axes = panels(figure)["mean return"]
    assert axes.lines[0].get_ydata() == pytest.approx(1.5 * np.arange(1.0, 31.0))
    assert axes.collections[0].get_paths()[0].vertices[:, 1].max() == pytest.approx(60.0)
    same = sweep_folder(tmp_path / "same", "{traffic: idm, seed: 0}", "{traffic: idm, seed: 1}")
    assert list(read_runs([same])) == ["all seeds"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "No such file"),
        (b"step,loss\n1,2\n", "decisions"),
        (b"\xff\xfe\x00broken", r"metrics\.csv"),
        (b"decisions,mean_return\n", "no rows"),
        (b"decisions,mean_return\n5,2\n10,text\n", r"metrics\.csv: .*'text'|text.*run's folder"),
    ],
)
def test_what_is_no_metrics_file_is_named(content, message, tmp_path):
    if content is not None:
        (tmp_path / "metrics.csv").write_bytes(content)
    with user_error(message):
        read_run(tmp_path)
