"""The dose experiment: what is trained, and what its table says of the held-out episodes."""

import polars as pl
import pytest
from reference.refusals import user_error

from benchmarks import dose
from benchmarks.script import ROOT, ReportSection, markdown
from ganlane.config.run import call_settings


def driven(folder, training, rewards, failed):
    """Held-out episodes of a finished training."""
    columns = {"episode": range(len(rewards)), "reward": rewards, "failed": failed}
    parts = [pl.DataFrame({"traffic": traffic, **columns}) for traffic in training.driven()]
    pl.concat(parts).write_parquet(folder / training.file)


def test_every_training_is_one_that_an_environment_takes_and_has_a_file_of_its_own():
    chosen = list(dose.trainings(2))
    assert len({training.file for training in chosen}) == len(chosen)
    # The first seeds of all doses first.
    assert [training.seed for training in chosen] == sorted(training.seed for training in chosen)
    for training in (one for one in chosen if one.seed == 0):
        config = call_settings("train", training.settings())
        assert config.traffic.label() == training.traffic


def test_a_training_drives_on_traffics_that_it_never_met_and_is_not_made_twice(
    tmp_path, monkeypatch, capsys
):
    pytest.importorskip("sb3_contrib")
    for name, value in (("DECISIONS", 128), ("ROWS", 2), ("EPISODES", 2)):
        monkeypatch.setattr(dose, name, value)
    monkeypatch.setattr(dose, "DOSES", {})
    arguments = ["train", "--folder", str(tmp_path), "--seeds", "1"]
    assert dose.main(arguments) == 0
    episodes = pl.read_parquet(tmp_path / "as_fitted_0.parquet")
    assert set(episodes["traffic"]) == {*dose.HELD_OUT, *dose.MET}
    assert len(episodes) == 2 * episodes["traffic"].n_unique()
    assert "done" in capsys.readouterr().out
    assert dose.main(arguments) == 0
    assert "done" not in capsys.readouterr().out


def test_the_table_tells_each_doses_difference_to_unchanged_drivers(tmp_path, capsys):
    for seed in range(2):
        unchanged = dose.Training(seed=seed)
        driven(tmp_path, unchanged, [100.0, 102.0 + seed], [False, True])
        changed = dose.Training("politeness", 0.0, seed)
        driven(tmp_path, changed, [110.0, 112.0 + seed], [False, False])
    assert dose.main(["table", "--folder", str(tmp_path)]) == 0
    told = capsys.readouterr().out
    row = next(line for line in told.splitlines() if "politeness" in line)
    assert "10.0 [" in row
    assert "-500.0 [" in row


def test_the_traffics_of_training_are_compared_on_each_of_them_and_on_others(tmp_path):
    unchanged = dose.Training()
    driven(tmp_path, unchanged, [100.0, 102.0], [False, False])
    driven(tmp_path, unchanged._replace(varied="traffic", dose="gan"), [90.0, 96.0], [True, False])
    table = dose.transfer_table(tmp_path)
    human, gan = (dict(zip(table.headings, line)) for line in table.lines)
    assert (human["trained on"], human["`human`"]) == ("`human`", "*101.0*")
    assert gan["`idm_faults`"].startswith("93.0; -8.0 [")
    assert gan["`gan`"].startswith("*93.0")


def test_the_table_in_the_documents_is_that_of_the_stored_episodes():
    page = ROOT / "docs" / "generators.md"
    folder = ROOT / "docs" / "reproduce" / "dose"
    tables = (dose.dose_table(folder), dose.transfer_table(folder))
    for name, table in zip(dose.SECTIONS, tables):
        assert ReportSection(page, name).read() == markdown(table)


def test_the_figure_has_a_panel_for_every_property(tmp_path):
    for training in (
        dose.Training(),
        dose.Training("delayed", 1),
    ):
        driven(tmp_path, training, [100.0, 102.0], [False, False])
    figure = dose.draw_effects(list(dose.effects(tmp_path)))
    panels = {axes.get_title(loc="left") or axes.get_title(): axes for axes in figure.axes}
    assert set(dose.DOSES) <= set(panels)
    # Zero, the interval and the mean of the one dose; zero alone elsewhere.
    assert len(panels["delayed"].lines) == 3
    assert len(panels["politeness"].lines) == 1


def test_without_trainings_it_says_what_to_run(tmp_path):
    with user_error("run 'train' first"):
        dose.dose_table(tmp_path)
