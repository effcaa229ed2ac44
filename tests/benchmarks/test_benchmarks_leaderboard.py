"""The leaderboard is what its stored results say, and these come out again to the last digit."""

import json

import polars as pl
import pytest
import torch
from reference.refusals import user_error

from benchmarks import leaderboard
from ganlane.agents.stored_models import load_model, save_network
from ganlane.native.library import find


@pytest.fixture(scope="module")
def shipped():
    return leaderboard.stored()["agent_general"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where results are stored: an empty folder."""
    monkeypatch.setattr(leaderboard, "FOLDER", tmp_path)
    return tmp_path


@pytest.fixture
def store(folder, shipped):
    """Stores the shipped results with changes under another name; gives the file."""

    def stored(name, **changes):
        file = folder / f"{name}.json"
        file.write_text(json.dumps({**shipped, **changes}))
        return file

    return stored


def test_the_page_is_made_from_the_stored_results():
    assert leaderboard.differences() == []


def test_the_first_episodes_come_out_as_stored_to_the_last_digit(shipped, monkeypatch):
    if isinstance(find(), str):
        pytest.skip("the tensor code differs from the kernel by rounding")
    cells = leaderboard.cells(shipped, every=False)
    assert {driver.name for driver, _ in cells} == shipped["sample"].keys()
    # CI drives the others, too.
    alone = [cell for cell in cells if cell[0].name == "agent_general"]
    assert len(alone) == leaderboard.TRAFFICS
    monkeypatch.setattr(leaderboard, "cells", lambda *_: alone)
    rewards = {}
    assert leaderboard.driven_again("shipped", shipped, rewards) == []
    assert sum(map(len, rewards.values())) == leaderboard.EPISODES * len(alone)


@pytest.mark.slow
def test_every_sampled_episode_comes_out_as_stored():
    assert leaderboard.main(["--check", "--all"]) == 0


@pytest.mark.parametrize("change", [1e-9, None])
def test_a_falsified_or_missing_sample_is_refused_in_one_sentence(
    capsys, shipped, store, change, monkeypatch
):
    def as_stored(drivers, config, **_):
        (traffic,) = config.traffics
        return pl.DataFrame({"reward": shipped["sample"][drivers[0].name][traffic]})

    # Driving again takes no time.
    monkeypatch.setattr(leaderboard, "compare", as_stored)
    store("mine")
    assert leaderboard.main(["--check"]) == 0
    changed = {
        traffic: [] if change is None else [rewards[0], rewards[1] + change]
        for traffic, rewards in shipped["sample"]["agent_general"].items()
    }
    store("mine", sample={**shipped["sample"], "agent_general": changed})
    capsys.readouterr()
    assert leaderboard.main(["--check"]) == 2
    (told,) = capsys.readouterr().err.strip().splitlines()
    assert told.startswith("error: mine: agent_general on ")
    assert ("has no sample" if change is None else ", episode 1: ") in told
    assert f"({leaderboard.TRAFFICS - 1} more differ)" in told


def test_of_a_run_what_the_page_needs_is_stored_and_of_its_models_the_layers_that_act(
    folder, shipped, store
):
    layers = torch.nn.Sequential(torch.nn.Linear(29, 8), torch.nn.ReLU(), torch.nn.Linear(8, 3))
    save_network(folder / "runs/mine/0.zip", layers)
    config = {"agents": [str(folder / "runs/mine"), "mobil"]}
    results = store("results", config=config, rows=["many"], failures=["many"])
    leaderboard.main(["--add", str(results), "--name", "mine"])
    stored = json.loads((folder / "mine.json").read_text())
    assert stored["agents"] == ["mine", "mobil"]
    assert stored["entries"] == shipped["entries"]
    assert not {"rows", "failures", "config"} & stored.keys()
    model, _ = load_model(folder / "mine/0.zip")
    assert torch.equal(model.layers[0].weight, layers[0].weight)


def test_an_entry_with_more_trainings_takes_the_place_of_one(shipped, store):
    store("a")
    store("b", entries=[{**entry, "trainings": 7} for entry in shipped["entries"]])
    store("c")
    lines = leaderboard.table("docs/leaderboard.md").splitlines()[2:]
    assert len(lines) == len(shipped["entries"])
    assert {line.split("|")[2].strip() for line in lines} == {"7"}


def test_results_of_another_protocol_are_refused(store):
    store("mine", protocol="0" * 12)
    with user_error("protocol 000000000000, expected"):
        leaderboard.stored()


@pytest.mark.parametrize("text", [None, "no JSON", "[]", '{"config": {}}'])
def test_what_is_no_result_of_a_benchmark_is_refused(tmp_path, text):
    file = tmp_path / "results.json"
    if text is not None:
        file.write_text(text)
    with user_error(r"not the results\.json of ganlane benchmark"):
        leaderboard.add(file, "mine")
