"""Episodes are asked for, and go on, by number, also through transforms."""

import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv

from ganlane.env import EpisodeParameters, HighwayEnv
from ganlane.sim.spawn import RandomScenes
from ganlane.sim.state import Road
from ganlane.traffic import IdmMobilTraffic
from ganlane.transforms import ObservationTransform, RewardTransform


def transformed(num_envs, goal_m=5000.0):
    base = HighwayEnv(IdmMobilTraffic(), num_envs=num_envs, episode=EpisodeParameters(goal_m=goal_m))
    return TransformedEnv(base, Compose(ObservationTransform(base.road), RewardTransform()))


def asked(*episodes, seed=0):
    counters = {"seed": torch.full((len(episodes),), seed), "episode": torch.tensor(episodes)}
    return TensorDict(counters, [len(episodes)])


def test_a_reset_runs_the_episodes_that_are_asked_for_through_transforms():
    state = transformed(3).reset(asked(7, 2, 2**40, seed=5))
    assert state["episode"].tolist() == [7, 2, 2**40]
    assert state["seed"].tolist() == [5, 5, 5]
    alone = transformed(1).reset(asked(2, seed=5))
    assert torch.equal(alone["observation"][0], state["observation"][1])


def test_rows_go_on_to_their_next_episodes_through_transforms():
    env = transformed(4, goal_m=40.0)
    state, seen = env.reset(), [set() for _ in range(4)]
    for _ in range(20):
        state["action"] = torch.zeros(4, dtype=torch.int64)
        _, state = env.step_and_maybe_reset(state)
        for row, episode in enumerate(state["episode"].tolist()):
            seen[row].add(episode)
    for row, episodes in enumerate(seen):
        assert len(episodes) > 2
        assert sorted(episodes) == [row + 4 * k for k in range(len(episodes))]


def test_after_asked_episodes_the_next_ones_follow_from_those():
    env = transformed(2, goal_m=40.0)
    state = env.reset(asked(10, 21))
    while (state["episode"] == torch.tensor([10, 21])).any():
        state["action"] = torch.zeros(2, dtype=torch.int64)
        _, state = env.step_and_maybe_reset(state)
    assert ((state["episode"] - torch.tensor([10, 21])) % 2 == 0).all()


def test_nonsense_in_the_padding_of_a_scene_reaches_nobody():
    """Scenes of one's own may leave anything where nobody is, NaN for one."""

    class Padded(RandomScenes):
        def __call__(self, key, dtype):
            scene = super().__call__(key, dtype)
            there = torch.arange(self.vehicles) != 2
            return scene.with_(
                valid=scene.valid & there,
                x=torch.where(there, scene.x, torch.nan),
                speed=torch.where(there, scene.speed, torch.inf),
            )

    road = Road(3)
    env = HighwayEnv(IdmMobilTraffic(road), 4, scenes=Padded(road, 9))
    state = env.reset()
    for _ in range(3):
        state["action"] = torch.zeros(4, dtype=torch.int64)
        _, state = env.step_and_maybe_reset(state)
    assert torch.isfinite(state["vehicles", "x"]).all()
    assert torch.isfinite(state["vehicles", "speed"]).all()
