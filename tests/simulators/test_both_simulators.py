"""What holds of the drivers of both foreign simulators."""

import pickle

import pytest
import torch
from reference.refusals import user_error
from reference.traffics import drive, overlaps
from reference.worlds import few_changes

import ganlane_simulators
from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.sim.state import Road

SIMULATORS = {"highway_env": "HighwayEnvTraffic", "libsumo": "SumoTraffic"}


@pytest.fixture(scope="module", params=SIMULATORS)
def traffic(request):
    pytest.importorskip(request.param)
    return getattr(ganlane_simulators, SIMULATORS[request.param])()


def test_an_ego_that_keeps_its_lane_crashes_with_nobody_and_nobody_with_another(traffic):
    vehicles, running, state = drive(HighwayEnv(traffic, 8), range(8), 40)
    assert running.all()
    assert not state[keys.EVENTS]["hard_crash"].any()
    assert overlaps(vehicles) == 0


def test_an_episode_is_the_same_alone_and_beside_others_whatever_was_driven_before(traffic):
    # In the middle of this the same roads have to be cleared, vehicles on their way across lanes
    # among them.
    drive(HighwayEnv(traffic, 3), [11, 12, 13], 17, few_changes)
    episodes = [1, 3, 6]
    together, running, _ = drive(HighwayEnv(traffic, 3), episodes, 24, few_changes)
    for row, episode in enumerate(episodes):
        alone, ran, _ = drive(HighwayEnv(traffic, 1), [episode], 24, few_changes)
        steps = int(running[:, row].sum())
        assert steps == int(ran.sum()) > 0
        for one, all_rows in zip(alone, together):
            assert torch.equal(one[: steps + 1, 0], all_rows[: steps + 1, row])


def test_a_copy_drives_on(traffic):
    drive(HighwayEnv(traffic, 1), [0], 1)
    copy = pickle.loads(pickle.dumps(traffic))
    one, other = (drive(HighwayEnv(model, 1), [0], 2)[0] for model in (traffic, copy))
    assert all(map(torch.equal, one, other))


def test_a_ring_is_refused(traffic):
    with user_error("ring of 500 m"):
        type(traffic)(Road(ring_m=500.0))
