"""``ganlane record`` writes datasets that minari loads, and that can be driven again."""

import json
import sys

import numpy as np
import pytest
from reference.refusals import refusal

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
    assert (dataset.observation_space, dataset.action_space) == (
        env.observation_space,
        env.action_space,
    )
    for number, (episode, about) in enumerate(
        zip(dataset, dataset.storage.get_episode_metadata(range(6)))
    ):
        assert (int(about["seed"]), int(about["options"]["episode"]), episode.id) == (
            3,
            number,
            number,
        )
        observation, info = env.reset(seed=3, options={"episode": number})
        for step, action in enumerate(episode.actions):
            np.testing.assert_allclose(observation, episode.observations[step], atol=1e-5)
            np.testing.assert_array_equal(info["action_mask"], episode.infos["action_mask"][step])
            observation, reward, terminated, truncated, info = env.step(action)
            assert reward == pytest.approx(episode.rewards[step], abs=1e-4)
            assert (terminated, truncated) == (
                episode.terminations[step],
                episode.truncations[step],
            )
        assert terminated or truncated
        assert len(episode.observations) == len(episode.infos["time_s"]) == len(episode.actions) + 1
        terms = sum(term[-1] for term in episode.infos["reward_terms"].values())
        assert terms == pytest.approx(episode.rewards[-1], abs=1e-4)


def test_the_call_from_python_names_the_dataset_and_says_how_the_episodes_ended(here):
    done = ganlane.api.run(
        "record",
        agent="keep_lane",
        episodes=3,
        goal_m=30.0,
        dataset="mine/first-v2",
        out="datasets",
    )
    assert done.results["dataset"] == "mine/first-v2"
    assert done.results["episodes"] == sum(done.results["ends"].values()) == 3
    assert done.results["decisions"] == minari.load_dataset("mine/first-v2").total_steps
    assert json.loads((done.folder / "results.json").read_text())["seeds"]["stream"] == "train"


def test_a_mistake_ends_in_one_sentence_and_leaves_nothing(capsys):
    told = refusal(capsys, "record", *TINY, "dataset=first")
    assert "dataset=first: expected a name such as highway/mobil-v0" in told


def test_a_dataset_that_is_there_is_kept(here, capsys):
    (here / "datasets" / "mine" / "first-v0").mkdir(parents=True)
    err = refusal(capsys, "record", *TINY, "dataset=mine/first-v0")
    assert "mine/first-v0: a dataset is there already; give another" in err


def test_without_minari_the_extra_is_named(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "minari.dataset.minari_storage", None)
    monkeypatch.delitem(sys.modules, "ganlane.commands.record", raising=False)
    assert "needs the extra 'minari'; run `pip install" in refusal(capsys, "record", *TINY)
