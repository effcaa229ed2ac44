"""Lorries: what the generator is told of them, and what the realism card measures."""

import numpy as np
import pytest
import torch
from reference.worlds import vehicles

from ganlane.generator.closed_loop import extra_inputs
from ganlane.realism.long_runs import LongRunParameters
from ganlane.realism.starts import spawned_recordings
from ganlane.sim import Road, SpawnParameters, perceive
from ganlane.traffic import IdmTraffic


def test_the_generator_is_told_the_gap_behind_the_lorry():
    """Centres 30 m apart, 21.75 m free; the input is gap / (gap + 20)."""
    scene = vehicles({"x": 0.0}, {"x": 30.0, "length": 12.0})
    zero = torch.zeros(1, 2)
    seen = extra_inputs(perceive(scene, Road()), zero, zero)
    assert seen[0, 0, 1].item() == pytest.approx(21.75 / 41.75)


def test_the_realism_card_measures_spawned_lorries_by_their_own_length():
    parameters = LongRunParameters(9, most_s=2.0, spawn=SpawnParameters(truck_share=0.5))
    recordings = spawned_recordings(IdmTraffic, Road(), parameters, rows=4)
    lengths = np.concatenate([recording.length for recording in recordings])
    assert set(lengths) == {4.5, 12.0}
    assert 0.2 < np.mean(lengths == 12.0) < 0.8
