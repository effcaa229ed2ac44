"""Traffic driven by a generator, with small random networks."""

import pytest
import torch
from reference.refusals import user_error
from reference.small_networks import anchored_drivers, small_generator
from reference.worlds import environment

from ganlane.native.drivers import GeneratedDrivers
from ganlane.settings.driving import IdmParameters
from ganlane.settings.generated import HEADWAY_QUANTILES_S
from ganlane.settings.generator import EXTRA_INPUTS
from ganlane.sim.random import Stream
from ganlane.sim.state import Road
from ganlane.traffic.social_gan import AnchoredGanTraffic, SocialGanTraffic

ROAD = Road(3, 4.0)


def paper(extra_inputs=0):
    network = small_generator(extra_inputs).requires_grad_(False)
    drivers = GeneratedDrivers(IdmParameters(), network.sizes, {}, Stream.TRAIN, 1.0, 5.0)
    return SocialGanTraffic(network, drivers, ROAD)


def calibrated(extra_inputs=EXTRA_INPUTS, headways_s=HEADWAY_QUANTILES_S):
    network = small_generator(extra_inputs).requires_grad_(False)
    return AnchoredGanTraffic(network, anchored_drivers(network, headways_s), ROAD)


@pytest.fixture(params=[paper, calibrated], ids=["paper", "calibrated"])
def module(request):
    return request.param()


def begin(module, rows=4, seed=5):
    """The first state of the episodes 0 to ``rows`` - 1."""
    return environment(num_envs=rows, traffic=module, seed=seed, dtype=torch.float32).reset()


def test_streams_seeds_and_episodes_give_other_drivers(module):
    one = begin(module, rows=2)["traffic", "noise"]
    assert (one[0] != one[1]).all()
    assert (one != begin(module, rows=2, seed=6)["traffic", "noise"]).all()
    module.stream = int(Stream.REPORT)
    assert (one != begin(module, rows=2)["traffic", "noise"]).all()


def test_a_vehicle_that_enters_has_driven_straight_at_its_present_speed(module):
    td = begin(module)
    assert all(leaf.shape[:2] == (4, 9) for leaf in td["traffic"].values())
    speed = td["vehicles", "speed"][1, 4]
    straight = torch.stack([0.1 * speed, 0.0 * speed])
    torch.testing.assert_close(td["traffic", "displacement"][1, 4], straight)


def moved_with(module, td, index, **changed):
    """What becomes of the vehicles if the one of this index is somewhere else."""
    other = td.clone()
    for name, value in changed.items():
        other["vehicles", name][:, index] = value
    return module(other)["moved"]


def test_who_is_not_valid_is_not_seen(module):
    td = begin(module)
    td["vehicles", "valid"][:, 3] = False
    one = module(td.clone())["moved", "x"]
    two = moved_with(module, td, 3, x=5.0, speed=1.0)["x"]
    rest = torch.arange(9) != 3
    torch.testing.assert_close(one[:, rest], two[:, rest])


def test_the_ego_is_a_neighbour_of_the_calibrated_drivers():
    module = calibrated()
    td = begin(module)
    away = moved_with(module, td, 0, x=10.0)
    assert (module(td)["moved", "speed"][:, 1:] != away["speed"][:, 1:]).any()


def test_headways_come_from_the_quantiles_given():
    module = calibrated(headways_s=(1.0, 1.1, 1.2, 1.3, 1.4))
    headway = begin(module, rows=200)["traffic", "headway"]
    assert 1.0 <= headway.min() < headway.max() <= 1.4
    assert headway.median().item() == pytest.approx(1.2, abs=0.03)


def test_the_other_presets_weights_are_refused():
    with user_error("expected 4"):
        calibrated(extra_inputs=0)
    with user_error("expected 0"):
        paper(extra_inputs=EXTRA_INPUTS)
