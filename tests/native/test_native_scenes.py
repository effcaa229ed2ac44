"""The kernel's first scenes for tensors are those of the tensor code, bit for bit, in the rows that are asked for."""

from __future__ import annotations

import pickle

import pytest
import torch

from ganlane.native.library import why_not
from ganlane.native.tensors import NativeScenes
from ganlane.parameters.driving import Visibility
from ganlane.parameters.episode import SpawnParameters
from ganlane.sim.random import episode_key
from ganlane.sim.spawn import RandomScenes
from ganlane.sim.state import Road

pytestmark = pytest.mark.skipif(why_not() is not None, reason="no native kernel here")
STREAM = 2
SCENES = {
    "the paper's": RandomScenes(),
    "lorries": RandomScenes(parameters=SpawnParameters(truck_share=0.4)),
    "one lane": RandomScenes(Road(lanes=1, lane_width_m=3.2), 5),
    "a crowd": RandomScenes(
        Road(lanes=5), 40, SpawnParameters(spread_m=400.0), Visibility.SIGNALLED, Visibility.BODY
    ),
}


@pytest.mark.parametrize("name", SCENES)
def test_every_number_is_that_of_the_tensor_code(name):
    scenes = SCENES[name]
    seed, episode = torch.full((200,), 7), torch.arange(200) * 13 - 50
    out, drawn = NativeScenes(scenes, STREAM).start(seed, episode)
    expected = scenes(episode_key(STREAM, seed, episode), torch.float32)
    for field, mine, theirs in zip(expected._fields, drawn, expected):
        assert mine.dtype == theirs.dtype, field
        assert torch.equal(mine, theirs), field
    at_rest = [made for name, made in out.items() if name not in {*drawn._fields}]
    assert not any(bool(each.any()) for each in at_rest)


def test_rows_that_are_not_asked_for_stay_empty():
    seed, episode = torch.zeros(600, dtype=torch.int64), torch.arange(600)
    rows = torch.arange(600) % 7 == 3
    kernel = NativeScenes(RandomScenes(), STREAM)
    (_, some), (_, every) = kernel.start(seed, episode, rows), kernel.start(seed, episode)
    assert torch.equal(some.x[rows], every.x[rows])
    assert not some.valid[~rows].any()
    assert not some.x[~rows].any()


def test_another_process_draws_the_same():
    seed, episode = torch.zeros(4, dtype=torch.int64), torch.arange(4)
    kernel = NativeScenes(RandomScenes(), STREAM)
    again = pickle.loads(pickle.dumps(kernel))
    assert torch.equal(again.start(seed, episode)[1].speed, kernel.start(seed, episode)[1].speed)
