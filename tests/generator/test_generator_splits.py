import pytest

from ganlane.data import SyntheticTraffic, synthetic_scenes
from ganlane.errors import UserError
from ganlane.generator.splits import assign_folds, split_for_fit
from ganlane.generator.windows import WINDOW_FRAMES, count_windows, cut_windows, scene_tracks


@pytest.fixture(scope="module")
def scenes():
    """Seven scenes of 2.5 to 8.5 s, so that they differ in their windows."""
    every = []
    for number in range(7):
        frame = synthetic_scenes(SyntheticTraffic(scenes=1, vehicles=6, seconds=2.5 + number), seed=number)
        (scene,) = scene_tracks(frame)
        every.append(type(scene)(**{**vars(scene), "name": f"scene-{number}"}))
    return every


def test_windows_are_counted_as_they_are_cut(scenes):
    assert [count_windows(scene, WINDOW_FRAMES) for scene in scenes] == [len(cut_windows([s])) for s in scenes]


@pytest.mark.parametrize("folds", [2, 3, 5, 7])
def test_every_scene_is_reported_once_and_the_folds_are_about_equal(scenes, folds):
    assigned = assign_folds(scenes, folds)
    assert sorted(name for fold in assigned for name in fold) == [scene.name for scene in scenes]
    sizes = {scene.name: count_windows(scene, WINDOW_FRAMES) for scene in scenes}
    held = [sum(sizes[name] for name in fold) for fold in assigned]
    assert max(held) - min(held) <= max(sizes.values())
    assert assign_folds(scenes[::-1], folds) == assigned


def test_reported_scenes_have_no_say_in_when_to_stop(scenes):
    for held_out in assign_folds(scenes, 3):
        split = split_for_fit(scenes, held_out)
        names = split.names
        assert sorted(name for part in names.values() for name in part) == [scene.name for scene in scenes]
        assert tuple(names["held_out"]) == held_out
        others = [*split.fitted, *split.validation]
        held = sum(count_windows(scene, WINDOW_FRAMES) for scene in split.validation)
        total = sum(count_windows(scene, WINDOW_FRAMES) for scene in others)
        assert total / 12 <= held < total / 2


def test_a_single_other_scene_is_fitted_to_and_chooses_when_to_stop(scenes):
    split = split_for_fit(scenes[:2], ("scene-1",))
    assert split.names == {"fitted": ["scene-0"], "validation": ["scene-0"], "held_out": ["scene-1"]}


def test_more_folds_than_scenes_are_refused(scenes):
    with pytest.raises(UserError, match="folds=8"):
        assign_folds(scenes, 8)
    with pytest.raises(UserError, match="at least 3 scenes"):
        assign_folds(scenes[:2], 2)
