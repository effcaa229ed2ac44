"""Desired speeds, which recordings do not show."""

import numpy as np

from ganlane.realism.fit_speeds import fit_excess
from ganlane.realism.recordings import Recording
from ganlane.realism.references import ConstantVelocity
from ganlane.realism.replay_starts import StartOptions


def test_the_excess_that_was_used_is_the_one_that_is_fitted():
    def eager(road):
        return Eager(road)

    class Eager(ConstantVelocity):
        """Drives at its desired speed at once."""

        def move(self, vehicles, memory, key, step):
            return super().move(vehicles.with_(speed=vehicles.desired_speed), memory, key, step)

    time = np.arange(80)[:, None] * 0.1
    random = np.random.default_rng(0)
    speed = 10.0 + 8.0 * random.uniform(size=30)
    x = 100.0 * np.arange(30) + speed * time
    shown = np.broadcast_to(np.where(np.arange(80)[:, None] == 0, 10.0, speed), x.shape).copy()
    size = np.ones(30)
    scene = Recording("a", "a", 1, 3.5, x, 0 * x, shown, x >= 0, 4 * size, 2 * size, size > 0)
    assert fit_excess(eager, [scene], StartOptions(repeats=1), (1.0, 4.0, 8.0)) == 4.0
