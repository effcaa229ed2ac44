"""Splits of scenes, fits of both presets, and k folds."""

from dataclasses import replace

import pytest
from reference.recordings import recorded_cars
from reference.refusals import user_error
from reference.small_networks import CALIBRATED, LOOP, PAPER
from reference.synthetic import synthetic_scenes

from ganlane.commands.train_generator import fold_tables
from ganlane.generator.fit import assign_folds, cross_validate, split_for_fit
from ganlane.generator.windows import count_windows


@pytest.fixture(scope="module")
def scenes():
    """Seven scenes of 2.5 to 8.5 s, so that they differ in their windows."""
    scenes = []
    for number in range(7):
        (scene,) = recorded_cars(scenes=1, vehicles=6, seconds=2.5 + number)
        scenes.append(replace(scene, name=f"scene-{number}"))
    return scenes


@pytest.mark.parametrize("folds", [2, 3, 5, 7])
def test_every_scene_is_reported_once_and_the_folds_are_about_equal(scenes, folds):
    assigned = assign_folds(scenes, folds)
    assert sorted(name for fold in assigned for name in fold) == [scene.name for scene in scenes]
    sizes = {scene.name: count_windows(scene) for scene in scenes}
    held = [sum(sizes[name] for name in fold) for fold in assigned]
    assert max(held) - min(held) <= max(sizes.values())
    assert assign_folds(scenes[::-1], folds) == assigned


def test_reported_scenes_have_no_say_in_when_to_stop(scenes):
    for held_out in assign_folds(scenes, 3):
        split = split_for_fit(scenes, held_out)
        names = [name for part in split.names.values() for name in part]
        assert sorted(names) == [scene.name for scene in scenes]
        assert tuple(split.names["held_out"]) == held_out
        held = sum(map(count_windows, split.validation))
        total = held + sum(map(count_windows, split.fitted))
        assert total / 12 <= held < total / 2


def test_more_folds_than_scenes_and_splits_without_two_parts_are_refused(scenes):
    with user_error("folds=8"):
        assign_folds(scenes, 8)
    with user_error("at least 3 scenes"):
        assign_folds(scenes[:2], 2)
    for held_out in (("nowhere",), (), tuple(scene.name for scene in scenes)):
        with user_error(r"data\.held_out="):
            split_for_fit(scenes, held_out)


@pytest.fixture(scope="module")
def frame():
    return synthetic_scenes(scenes=3, vehicles=5, seconds=6.5)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fits")


@pytest.fixture(scope="module")
def paper(frame, folder):
    """Scores of two folds."""
    return cross_validate(PAPER, frame, 2, folder)


def test_every_scene_is_forecast_once_by_a_generator_that_never_saw_it(paper):
    splits = paper["splits"]
    open_loop = paper["open_loop"]
    held_out = {name for split in splits for name in split["held_out"]}
    assert held_out == set(open_loop["scenes"])
    for split in splits:
        assert not set(split["held_out"]) & {*split["fitted"], *split["validation"]}
    assert open_loop["windows"] == sum(row["windows"] for row in open_loop["folds"].values()) > 0
    assert "best_of_20" in fold_tables(paper)


def test_what_is_fitted_is_not_fitted_again_and_gives_the_same(frame, folder, paper):
    updates = []
    assert cross_validate(PAPER, frame, 2, folder, updates.append) == paper
    assert not updates
    cross_validate(replace(PAPER, seed=1), frame, 2, folder, updates.append)
    assert len(updates) == 2 * LOOP.updates


def test_the_calibrated_preset_is_also_rolled_out_for_five_seconds(frame, folder):
    calibrated = cross_validate(CALIBRATED, frame, 2, folder)
    rollout = calibrated["rollout"]
    assert rollout["windows"] >= 15
    assert list(rollout["rmse_m"]["mean"]) == ["1 s", "2 s", "3 s", "4 s", "5 s"]
    assert rollout["ratio_to_constant_velocity"]["constant_velocity"] == 1.0
    assert calibrated["open_loop"]["windows"] > rollout["windows"]
    assert "idm_own_headway" in fold_tables(calibrated)
