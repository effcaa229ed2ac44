"""Everybody from the same recorded scenes, and from some of them alone."""

import numpy as np
import pytest

from ganlane.data import SyntheticTraffic, synthetic_scenes
from ganlane.errors import UserError
from ganlane.realism.card import card_rows
from ganlane.realism.distances import ceiling
from ganlane.realism.long_runs import LongRunParameters
from ganlane.realism.references import ConstantVelocity
from ganlane.realism.replay_starts import StartOptions
from ganlane.realism.starts import Fold, recorded_starts, spawned_frame
from ganlane.sim.state import Road
from ganlane.traffic import IdmTraffic

NAMES = [f"synthetic-{number}" for number in range(4)]
MAKERS = {"cruise": ConstantVelocity}


@pytest.fixture(scope="module")
def frame():
    return synthetic_scenes(SyntheticTraffic(scenes=4, vehicles=8, seconds=6.0))


def starts_of(frame, *folds, fit=False):
    said = []
    return recorded_starts(folds, frame, StartOptions(), fit, "made up", said.append), said


def test_scenes_alone_have_the_ceiling_of_their_own_halves(frame):
    starts, _ = starts_of(frame, Fold(MAKERS, NAMES, NAMES[1:3]))
    assert starts.separately_held_out == NAMES[1:3]
    alone = card_rows(starts.restricted_to(starts.separately_held_out), "cruise", 100)
    for name in ("speed", "gap"):
        assert alone[name]["ceiling"] == ceiling(starts.recorded[name][1:3])
        assert alone[name]["ceiling"] != card_rows(starts, "cruise", 100)[name]["ceiling"]
        assert alone[name]["recorded_samples"] == starts.recorded[name][1:3].sum()


def test_folds_are_driven_one_by_one_and_told_together(frame):
    folds = Fold(MAKERS, NAMES[:2], NAMES[:2]), Fold(MAKERS, NAMES[2:], NAMES[2:])
    apart, _ = starts_of(frame, *folds)
    whole, _ = starts_of(frame, Fold(MAKERS, NAMES, []))
    assert apart.scenes == whole.scenes == NAMES
    assert apart.separately_held_out == []
    assert np.array_equal(apart.driven["cruise"].counts["speed"], whole.driven["cruise"].counts["speed"])


def test_a_fold_without_scenes_is_passed_over_and_none_at_all_is_refused(frame):
    starts, _ = starts_of(frame, Fold(MAKERS, [], []), Fold(MAKERS, NAMES[:2], []))
    assert starts.scenes == NAMES[:2]
    with pytest.raises(UserError, match="no scene to start from"):
        starts_of(frame, Fold(MAKERS, [], []))
    with pytest.raises(UserError, match="moon"):
        starts_of(frame, Fold(MAKERS, NAMES, ["moon"]))


def test_spawned_trajectories_are_whole_tracks_in_the_schema():
    frame = spawned_frame(IdmTraffic, Road(), LongRunParameters(5, most_s=10.0), 2)
    assert frame.height == 2 * 5 * 101
    assert frame["unit"].unique().sort().to_list() == ["spawned-0", "spawned-1"]
