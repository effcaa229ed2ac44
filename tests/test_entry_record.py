"""``ganlane record`` writes datasets that minari loads, and that can be driven again."""

import sys

import numpy as np
import pytest
from reference.refusals import refusal, results_in

import ganlane
from ganlane.__main__ import main

minari = pytest.importorskip("minari", reason="minari is not installed")
pytest.importorskip("h5py", reason="h5py is not installed")


@pytest.fixture(autouse=True)
def here(empty_folder, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(empty_folder / "datasets"))
    return empty_folder


TINY = ["num_envs=4", "env.goal_m=60", "out=datasets"]


def test_a_dataset_is_listed_loaded_split_and_driven_again_by_minari(capsys):
    six = ["agent=random_legal", "traffic=idm_mobil", "episodes=6", "seed=3", "mask=legal"]
    assert main(["record", *TINY, *six]) == 0
    name = "ganlane/idm_mobil/random_legal-v0"
    assert f"minari.load_dataset('{name}')" in capsys.readouterr().out
    assert list(minari.list_local_datasets()) == [name]
    dataset = minari.load_dataset(name)
    assert dataset.total_episodes == 6
    assert [part.total_episodes for part in minari.split_dataset(dataset, [4, 2], seed=0)] == [4, 2]
    env = dataset.recover_environment()
    assert env.spec.max_episode_steps == dataset.env_spec.max_episode_steps == 1000
    assert dataset.observation_space == env.observation_space
    assert dataset.action_space == env.action_space
    about = dataset.storage.get_episode_metadata(range(6))
    for number, (episode, its) in enumerate(zip(dataset, about)):
        assert episode.id == number
        assert (int(its["seed"]), int(its["options"]["episode"])) == (3, number)
        observation, info = env.reset(seed=3, options={"episode": number})
        states, masks, outcomes = [observation], [info["action_mask"]], []
        for action in episode.actions:
            observation, *outcome, info = env.step(action)
            states.append(observation)
            masks.append(info["action_mask"])
            outcomes.append(outcome)
        np.testing.assert_allclose(episode.observations, states, atol=1e-5)
        np.testing.assert_array_equal(episode.infos["action_mask"], masks)
        stored = zip(episode.rewards, episode.terminations, episode.truncations)
        np.testing.assert_allclose(list(stored), outcomes, atol=1e-4)
        assert any(outcomes[-1][1:])
        assert len(episode.infos["time_s"]) == len(states)
        terms = sum(term[-1] for term in episode.infos["reward_terms"].values())
        assert terms == pytest.approx(episode.rewards[-1], abs=1e-4)


def test_the_call_from_python_names_the_dataset_and_says_how_the_episodes_ended():
    name = "mine/first-v2"
    options = {"agent": "keep_lane", "episodes": 3, "goal_m": 30.0, "out": "datasets"}
    done = ganlane.api.run("record", dataset=name, **options)
    assert done.results["dataset"] == name
    assert done.results["episodes"] == sum(done.results["ends"].values()) == 3
    assert done.results["decisions"] == minari.load_dataset(name).total_steps
    assert results_in(done.folder)["seeds"]["stream"] == "train"


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("first", "dataset=first: expected a name such as highway/mobil-v0"),
        ("mine/first-v0", "mine/first-v0: a dataset is there already; give another"),
    ],
)
def test_a_wrong_name_is_refused_and_a_dataset_that_is_there_kept(name, told, here, capsys):
    (here / "datasets" / "mine" / "first-v0").mkdir(parents=True)
    assert told in refusal(capsys, "record", *TINY, f"dataset={name}")


def test_without_minari_the_extra_is_named(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "minari.dataset.minari_storage", None)
    monkeypatch.delitem(sys.modules, "ganlane.commands.record", raising=False)
    assert "needs the extra 'minari'; run `pip install" in refusal(capsys, "record", *TINY)
