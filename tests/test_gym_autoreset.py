"""What happens to a row of a gymnasium batch whose episode has ended, in each of gymnasium's three modes."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector
from reference.gym_env import KEEP, LEFT, make_vec

from ganlane.errors import UserError


def returns_by_episode(mode, kernel):
    """Return of every finished episode by its number, rows in ``mode``; all rows keep their lanes."""
    envs = make_vec(3, kernel=kernel, autoreset_mode=mode, goal_m=120.0)
    assert envs.metadata["autoreset_mode"] is mode
    _, info = envs.reset(seed=4)
    running, numbers, ended, returns = np.zeros(3), info["episode_number"], np.zeros(3, bool), {}
    for _ in range(40):
        before = ended
        _, reward, terminated, truncated, info = envs.step(np.zeros(3, int))
        if mode is AutoresetMode.NEXT_STEP:
            assert not reward[before].any()
            assert not info["time_s"][before].any()
        running += reward
        ended = terminated | truncated
        returns |= {int(numbers[row]): running[row] for row in np.flatnonzero(ended)}
        if mode is AutoresetMode.DISABLED and ended.any():
            _, info = envs.reset(options={"reset_mask": ended})
        running[ended], numbers = 0.0, info["episode_number"]
    return returns


@pytest.mark.parametrize("kernel", ["auto", "torch"])
def test_episodes_are_the_same_in_every_autoreset_mode(kernel):
    same = returns_by_episode(AutoresetMode.SAME_STEP, kernel)
    for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED):
        other = returns_by_episode(mode, kernel)
        shared = same.keys() & other.keys()
        assert len(shared) >= 9
        assert {number: other[number] for number in shared} == pytest.approx({n: same[n] for n in shared}, abs=1e-3)


def test_a_row_that_is_over_is_not_stepped_where_resets_are_left_to_the_user():
    envs = make_vec(2, lanes=1, autoreset_mode="disabled")
    envs.reset(seed=0)
    envs.step(np.array([LEFT, KEEP]))
    with pytest.raises(UserError, match=r"rows \[0\] are over; call reset"):
        envs.step(np.array([KEEP, KEEP]))
    with pytest.raises(UserError, match="expected one of next_step, same_step, disabled"):
        make_vec(2, autoreset_mode="never")


def test_gymnasiums_own_vector_wrappers_take_the_batch():
    envs = make_vec(4, goal_m=40.0, autoreset_mode=AutoresetMode.NEXT_STEP)
    envs = vector.NormalizeObservation(vector.RecordEpisodeStatistics(envs))
    envs.reset(seed=0)
    lengths = []
    for _ in range(12):
        *_, info = envs.step(np.zeros(4, int))
        if "episode" in info:
            lengths += info["episode"]["l"][info["_episode"]].tolist()
    assert len(lengths) >= 4
    assert all(1 <= length <= 6 for length in lengths)
