"""The contract of all traffic models: what is written, in which shapes, and what is not."""

import pytest
import torch
from reference.refusals import user_error
from reference.synthetic import synthetic_scenes
from reference.traffics import MAKE
from reference.worlds import environment, same_bits
from tensordict import TensorDict

from ganlane import keys
from ganlane.data import sort
from ganlane.sim import Vehicles
from ganlane.traffic import (
    BlindTraffic,
    IdmMobilTraffic,
    MixedTraffic,
    ReplayTraffic,
    TrafficSequential,
)
from ganlane.traffic.base import zero_memory
from ganlane.traffic.presets import gan_calibrated_traffic

SHARES = {"idm": 1, "idm_faults": 1}


def replay():
    scenes = sort(synthetic_scenes(scenes=2, lanes=3, seconds=8.0))
    return ReplayTraffic(recordings=scenes)


MODELS = {
    **MAKE,
    "gan_calibrated": gan_calibrated_traffic,
    "mixed": lambda: MixedTraffic({name: MAKE[name]() for name in SHARES}, SHARES),
    "blind": lambda: BlindTraffic(IdmMobilTraffic(), 0.5),
    "replay": replay,
}


def shapes(memory):
    """Nested name -> (shape, dtype)."""
    return {
        name: shapes(value) if isinstance(value, TensorDict) else (tuple(value.shape), value.dtype)
        for name, value in memory.items()
    }


@pytest.mark.parametrize("name", MODELS)
def test_memory_and_moved_are_as_declared_and_the_state_at_t_is_never_written(name):
    traffic = MODELS[name]()
    state = environment(num_envs=4, traffic=traffic, dtype=torch.float32).reset()
    for step in range(2):
        before = state.clone()
        declared = zero_memory(traffic.memory_fields, state[keys.VEHICLES, "x"])
        assert shapes(state.get(keys.TRAFFIC, TensorDict({}))) == shapes(declared)
        after = traffic(state.clone(recurse=False))
        assert same_bits(state, before) == []
        moved = after[keys.MOVED]
        assert shapes(moved) == shapes(before[keys.VEHICLES])
        assert tuple(Vehicles.of(moved)._fields) == keys.VEHICLE_FIELDS
        others = before[keys.VEHICLES, "valid"] & (torch.arange(9) > 0)
        assert (moved["x"] > before[keys.VEHICLES, "x"])[others].all()
        state[keys.VEHICLES] = moved
        state[keys.STEP] = torch.full((4,), step + 1)
        state[keys.TRAFFIC] = after.get(keys.TRAFFIC, TensorDict({}, [4]))


def test_a_chain_begins_with_a_model_that_reacts():
    with user_error("overlays behind replayed traffic"):
        TrafficSequential({"base": replay()})
