"""Everybody from the same recorded scenes, from some of them, and with fitted desired speeds."""

import numpy as np
import pytest
from reference.recordings import made_by_hand
from reference.refusals import user_error
from reference.synthetic import synthetic_scenes

from ganlane.realism.card import card_rows
from ganlane.realism.driving import ConstantVelocity, StartOptions
from ganlane.realism.measures import ceiling
from ganlane.realism.starts import fit_excess, recorded_starts

NAMES = [f"synthetic-{number}" for number in range(4)]


@pytest.fixture(scope="module")
def frame():
    return synthetic_scenes(scenes=4, vehicles=8, seconds=6.0)


def starts_of(frame, starts, held_out):
    cruise = {"cruise": ConstantVelocity}
    return recorded_starts(cruise, starts, held_out, frame, StartOptions(), False, "made up")


def test_scenes_alone_have_the_ceiling_of_their_own_halves(frame):
    starts = starts_of(frame, NAMES[:3], NAMES[1:3])
    assert starts.scenes == NAMES[:3]
    held_out = starts.held_out_alone()
    assert held_out.scenes == NAMES[1:3]
    assert held_out.held_out_alone() is None
    # The ceiling is that of two scenes, no longer of three.
    alone = card_rows(held_out, 100)
    for name in ("speed", "gap"):
        assert alone[name]["ceiling"] == ceiling(starts.recorded.counts[name][1:3])
        assert alone[name]["ceiling"] != card_rows(starts, 100)[name]["ceiling"]
        assert alone[name]["recorded_samples"] == starts.recorded.counts[name][1:3].sum()


def test_scenes_that_are_not_there_are_refused(frame):
    with user_error("no scene to start from"):
        starts_of(frame, [], [])
    with user_error("moon"):
        starts_of(frame, NAMES, ["moon"])


def test_the_excess_that_was_used_is_the_one_that_is_fitted():
    class Eager(ConstantVelocity):
        """Drives at its desired speed at once."""

        def move(self, vehicles, memory, key, step):
            return super().move(vehicles.with_(speed=vehicles.desired_speed), memory, key, step)

    time = np.arange(80)[:, None] * 0.1
    random = np.random.default_rng(0)
    # Everybody drives by 0 to 8 m/s faster than at the start.
    speed = 10.0 + 8.0 * random.uniform(size=30)
    x = 100.0 * np.arange(30) + speed * time
    shown = np.where(np.arange(80)[:, None] == 0, 10.0, speed)
    scene = made_by_hand(x, speed=shown, lanes=1)
    assert fit_excess(Eager, [scene], StartOptions(repeats=1), (1.0, 4.0, 8.0)) == 4.0
