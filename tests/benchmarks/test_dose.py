"""What each dose is worth, from trainings whose agents drove on held-out traffics."""

import numpy as np
import polars as pl
import pytest

from benchmarks.dose import DOSES, MASKS, UNCHANGED, Training, dose_table, trainings
from ganlane.errors import UserError
from ganlane.settings.record import make
from ganlane.settings.traffic import TrafficConfig


def drive(folder, training, reward, failed):
    """What an agent of this mean reward, with failures in these episodes, would leave behind."""
    random = np.random.default_rng(training.seed)
    home = folder / training.name
    home.mkdir()
    episodes = range(40)
    table = {
        "traffic": "idm_faults",
        "episode": episodes,
        "reward": reward + random.normal(0.0, 1.0, 40),
        "failed": [number in failed for number in episodes],
    }
    pl.DataFrame(table).write_parquet(home / "held_out.parquet")


def test_a_dose_is_worth_its_difference_to_unchanged_drivers(tmp_path):
    for seed in range(3):
        drive(tmp_path, Training("safe", UNCHANGED, None, seed), 250.0 + seed, {3})
        drive(tmp_path, Training("safe", "delayed", 2, seed), 240.0 + seed, {3, 4})
    *_, first, second = dose_table(tmp_path, seeds=3).splitlines()
    assert first.split()[:4] == ["safe", "as", "fitted", "3"]
    assert float(first.split()[4]) == pytest.approx(251.0, abs=1.0)
    words = second.replace("[", " ").replace(",", " ").replace("]", " ").split()
    assert words[:4] == ["safe", "delayed", "2", "3"]
    value, low, high, failures = (float(word) for word in words[4:8])
    assert low < value < high < 0.0
    assert value == pytest.approx(-10.0, abs=1.0)
    # One episode of 40 more.
    assert failures == pytest.approx(25.0)


def test_without_trainings_there_is_nothing_to_compare_with(tmp_path):
    with pytest.raises(UserError, match="train"):
        dose_table(tmp_path, seeds=1)


def test_every_dose_is_a_setting_and_has_a_folder_of_its_own():
    everything = list(trainings(seeds=2))
    assert len({training.name for training in everything}) == len(everything)
    assert len(everything) == 2 * len(MASKS) * (1 + sum(map(len, DOSES.values())))
    for training in everything:
        traffic = training.settings()["traffic"]
        if isinstance(traffic, dict) and training.dose is not None:
            config = make(TrafficConfig, traffic)
            assert getattr(config, training.varied) == training.dose
