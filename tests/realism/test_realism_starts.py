"""Everybody from the same recorded scenes, and from some of them alone."""

import numpy as np
import pytest

from ganlane.data import SyntheticTraffic, synthetic_scenes
from ganlane.errors import UserError
from ganlane.evaluation.realism.card import rows_of
from ganlane.evaluation.realism.distances import ceiling
from ganlane.evaluation.realism.drivers import ConstantVelocity
from ganlane.evaluation.realism.folds import Fold
from ganlane.evaluation.realism.simulation import StartOptions
from ganlane.evaluation.realism.starts import recorded_starts

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
    assert starts.unseen == NAMES[1:3]
    alone = rows_of(starts.only(starts.unseen), "cruise", 100)
    for name in ("speed", "gap"):
        assert alone[name]["ceiling"] == ceiling(starts.recorded[name][1:3])
        assert alone[name]["ceiling"] != rows_of(starts, "cruise", 100)[name]["ceiling"]
        assert alone[name]["recorded_samples"] == starts.recorded[name][1:3].sum()


def test_folds_are_driven_one_by_one_and_told_together(frame):
    folds = Fold(MAKERS, NAMES[:2], NAMES[:2]), Fold(MAKERS, NAMES[2:], NAMES[2:])
    apart, _ = starts_of(frame, *folds)
    whole, _ = starts_of(frame, Fold(MAKERS, NAMES, []))
    assert apart.scenes == whole.scenes == NAMES
    assert apart.unseen == []
    assert np.array_equal(apart.driven["cruise"].counts["speed"], whole.driven["cruise"].counts["speed"])


def test_a_fold_without_scenes_is_passed_over_and_none_at_all_is_refused(frame):
    starts, _ = starts_of(frame, Fold(MAKERS, [], []), Fold(MAKERS, NAMES[:2], []))
    assert starts.scenes == NAMES[:2]
    with pytest.raises(UserError, match="no scene to start from"):
        starts_of(frame, Fold(MAKERS, [], []))
    with pytest.raises(UserError, match="moon"):
        starts_of(frame, Fold(MAKERS, NAMES, ["moon"]))
