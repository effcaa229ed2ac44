"""An episode is the same bit for bit in any batch, in any slot and when it is replayed by its
number.
"""

import pytest
import torch
from reference.worlds import (
    Track,
    assert_same_tracks,
    environment,
    few_changes,
    run,
    same_bits,
    tracks,
)

from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.settings.driving import Visibility
from ganlane.sim.spawn import RandomScenes
from ganlane.sim.state import Road
from ganlane.traffic import IdmMobilTraffic
from ganlane.transforms import OBSERVATIONS, ObservationTransform


def make(num_envs: int) -> HighwayEnv:
    """Short episodes: some reach the goal, others leave the road, crash or run out of time."""
    return environment(
        num_envs=num_envs,
        goal_m=140.0,
        timeout_s=9.5,
        seed=17,
        visibility=Visibility.CENTRE,
        dtype=torch.float32,
    )


@pytest.fixture(scope="module")
def in_64() -> dict[int, Track]:
    """Episodes 0 to 63, each the first of its row."""
    return tracks(make(64), 11, few_changes)


def test_the_episodes_compared_end_in_several_ways():
    states = run(make(64), 10, few_changes)
    seen = {name for name in keys.END_EVENTS for td in states if td[keys.EVENTS, name].any()}
    assert seen >= {"goal", "out_of_road", "timeout", "hard_crash"}


@pytest.mark.parametrize(
    ("batch", "decisions", "episodes", "at_least"),
    [
        (7, 22, None, 14),  # in the middle of a run
        (1, 22, None, 2),  # alone
        # Replayed from their numbers, in any slot.
        (1, 11, [61], 1),
        (7, 11, [5, 40, 3, 21, 63, 0, 13], 7),
    ],
)
def test_an_episode_is_the_same_in_any_batch_and_slot(in_64, batch, decisions, episodes, at_least):
    assert_same_tracks(tracks(make(batch), decisions, few_changes, episodes), in_64, at_least)


@pytest.mark.slow
def test_an_episode_is_the_same_in_a_batch_of_4096(in_64):
    in_4096 = tracks(make(4096), 11, few_changes)
    assert_same_tracks(in_4096, in_64, at_least=60)
    assert_same_tracks(tracks(make(3), 11, few_changes, [4095, 2048, 1000]), in_4096, at_least=3)


class Padded(RandomScenes):
    """With nobody at one place, and a number of one's choice in its fields."""

    nonsense = 0.0

    def __call__(self, key, dtype):
        scene = super().__call__(key, dtype)
        there = torch.arange(self.vehicles) != 2
        return scene.with_(
            valid=scene.valid & there,
            x=torch.where(there, scene.x, self.nonsense),
            speed=torch.where(there, scene.speed, self.nonsense),
        )


def driven_with(nonsense: float):
    """The last state of three decisions, with zeros where nobody is, and all observations of it."""
    scenes = Padded(Road(3), 9)
    scenes.nonsense = nonsense
    env = HighwayEnv(IdmMobilTraffic(Road(3)), 4, scenes=scenes)
    *_, state = run(env, 3, few_changes)
    seen = [ObservationTransform(Road(3), 9, form)(state.clone()) for form in OBSERVATIONS]
    there = state[keys.VEHICLES, "valid"]
    for name, field in state[keys.VEHICLES].items():
        state[keys.VEHICLES, name] = torch.where(there, field, 0)
    return state.exclude(keys.TRAFFIC), torch.cat([td[keys.OBSERVATION] for td in seen], dim=1)


def test_nonsense_in_the_padding_of_a_scene_reaches_nobody():
    """Scenes of one's own may leave anything where nobody is: not a bit of the others changes, and
    none of what the agent reads.
    """
    expected, observations = driven_with(0.0)
    assert torch.isfinite(observations).all()
    for nonsense in (5.0, torch.nan, torch.inf):
        state, seen = driven_with(nonsense)
        assert same_bits(state, expected) == []
        assert torch.equal(seen, observations)
