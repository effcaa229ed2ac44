"""The dose experiment: what is trained, and what its table says of the held-out episodes."""

import polars as pl
import pytest

from benchmarks import dose
from ganlane.config.run import call_settings


def driven(folder, training, rewards, failed):
    """Held-out episodes of a finished training."""
    home = folder / training.name
    home.mkdir(parents=True)
    columns = {"traffic": "idm_faults", "episode": range(len(rewards))}
    frame = pl.DataFrame({**columns, "reward": rewards, "failed": failed})
    frame.write_parquet(home / "held_out.parquet")


def test_every_training_is_one_that_the_command_takes_and_has_a_folder_of_its_own():
    chosen = list(dose.trainings(2))
    assert len({training.name for training in chosen}) == len(chosen)
    # One mask after the other, and the first seeds of all doses first.
    order = [(dose.MASKS.index(training.mask), training.seed) for training in chosen]
    assert order == sorted(order)
    for training in (one for one in chosen if one.seed == 0):
        config = call_settings("train", {"experiment": "dose", **training.settings()})
        assert config.traffic.label() == "human"


def test_the_table_tells_each_doses_difference_to_unchanged_drivers(tmp_path, capsys):
    for seed in range(2):
        unchanged = dose.Training("legal", dose.UNCHANGED, None, seed)
        driven(tmp_path, unchanged, [100.0, 102.0 + seed], [False, True])
        changed = dose.Training("legal", "politeness", 0.0, seed)
        driven(tmp_path, changed, [110.0, 112.0 + seed], [False, False])
    assert dose.main(["table", "--folder", str(tmp_path)]) == 0
    told = capsys.readouterr().out
    row = next(line for line in told.splitlines() if "politeness" in line)
    assert "10.0 [" in row
    assert "-500.0 [" in row


def test_without_trainings_it_says_what_to_run(tmp_path, capsys):
    assert dose.main(["table", "--folder", str(tmp_path)]) == 2
    assert "run 'train' first" in capsys.readouterr().err


@pytest.mark.parametrize("part", ["2/2", "half", "1"])
def test_a_part_that_is_none_is_refused(part, capsys):
    with pytest.raises(SystemExit):
        dose.main(["train", "--part", part])
    assert "--part" in capsys.readouterr().err
