"""An episode is the same bit for bit in any batch, in any slot and when it is replayed by its number."""

from __future__ import annotations

import pytest
import torch
from reference.worlds import environment, leaves, same_bits
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv

from ganlane import keys
from ganlane.env import EpisodeParameters, HighwayEnv
from ganlane.parameters.driving import Visibility
from ganlane.sim.spawn import RandomScenes
from ganlane.sim.state import Road
from ganlane.traffic import IdmMobilTraffic
from ganlane.transforms import ObservationTransform, RewardTransform

Track = list[torch.Tensor]


def make(num_envs: int, mobil: bool) -> HighwayEnv:
    """Short episodes: some reach the goal, others leave the road, crash or run out of time."""
    return environment(
        num_envs=num_envs,
        mobil=mobil,
        goal_m=140.0,
        timeout_s=9.5,
        seed=17,
        visibility=Visibility.CENTRE,
        dtype=torch.float32,
    )


def action(td) -> torch.Tensor:
    """A fixed function of the episode and the decision."""
    number = (td[keys.EPISODE] * 7 + td[keys.EGO, "decisions"] * 5) % 11
    return torch.where(number == 1, keys.LEFT, torch.where(number == 2, keys.RIGHT, keys.KEEP))


def rows(td) -> torch.Tensor:
    """Everything about the state of each row, exactly (a float32 and a small integer fit into a float64)."""
    parts = [value.reshape(value.shape[0], -1).double() for name, value in leaves(td) if name != keys.EPISODE]
    return torch.cat(parts, dim=1)


def run(env: HighwayEnv, decisions: int) -> dict[int, Track]:
    """Episode to its states, over a run with automatic resets; unfinished episodes are left out."""
    tracks: dict[int, Track] = {}
    finished = set()
    td = env.reset()
    for _ in range(decisions):
        td["action"] = action(td)
        stepped, td = env.step_and_maybe_reset(td)
        after = stepped["next"].exclude("reward", "action")
        states = rows(after)
        for row, episode in enumerate(after[keys.EPISODE].tolist()):
            tracks.setdefault(episode, []).append(states[row])
            if after["done"][row]:
                finished.add(episode)
    return {episode: tracks[episode] for episode in finished}


def replay(env: HighwayEnv, episodes: list[int]) -> dict[int, Track]:
    """The same for episodes asked for by their numbers, without any reset in between."""
    asked = env.reset().select(keys.SEED, keys.EPISODE)
    asked[keys.EPISODE] = torch.tensor(episodes)
    td = env.reset(asked)
    tracks: dict[int, Track] = {episode: [] for episode in episodes}
    going = [True] * len(episodes)
    while any(going):
        td["action"] = action(td)
        td = env.step(td)["next"].exclude("reward", "action")
        for row, episode in enumerate(episodes):
            if going[row]:
                tracks[episode].append(rows(td)[row])
                going[row] = not td["done"][row].item()
    return tracks


def assert_same_tracks(some: dict[int, Track], reference: dict[int, Track], at_least: int) -> None:
    common = some.keys() & reference.keys()
    assert len(common) >= at_least
    for episode in common:
        assert len(some[episode]) == len(reference[episode]), episode
        assert torch.equal(torch.stack(some[episode]), torch.stack(reference[episode])), episode


@pytest.fixture(scope="module", params=[True, False], ids=["idm_mobil", "idm"])
def mobil(request) -> bool:
    return request.param


@pytest.fixture(scope="module")
def in_64(mobil) -> dict[int, Track]:
    """Episodes 0 to 63, each the first of its row."""
    return run(make(64, mobil), 11)


def test_the_episodes_compared_end_in_several_ways(mobil):
    env = make(64, mobil)
    seen = dict.fromkeys(keys.END_EVENTS, 0)
    td = env.reset()
    for _ in range(10):
        td["action"] = action(td)
        stepped, td = env.step_and_maybe_reset(td)
        for name in seen:
            seen[name] += stepped["next", keys.EVENTS, name].sum().item()
    assert min(seen[name] for name in ("goal", "out_of_road", "timeout")) > 0
    assert seen["hard_crash"] > 0 or not mobil


def test_an_episode_is_the_same_in_a_batch_of_7_in_the_middle_of_a_run(mobil, in_64):
    assert_same_tracks(run(make(7, mobil), 45), in_64, at_least=25)


def test_an_episode_is_the_same_alone(mobil, in_64):
    assert_same_tracks(run(make(1, mobil), 45), in_64, at_least=4)


@pytest.mark.parametrize("episodes", [[61], [5, 40, 3, 21, 63, 0, 12]])
def test_an_episode_is_replayed_from_its_numbers_in_any_slot(mobil, in_64, episodes):
    assert_same_tracks(replay(make(len(episodes), mobil), episodes), in_64, at_least=len(set(episodes)))


@pytest.mark.slow
def test_an_episode_is_the_same_in_a_batch_of_4096(mobil, in_64):
    in_4096 = run(make(4096, mobil), 11)
    assert_same_tracks(in_4096, in_64, at_least=60)
    later = [4095, 2048, 1000]
    assert_same_tracks(replay(make(3, mobil), later), in_4096, at_least=3)


def test_a_saved_state_goes_on_in_another_environment(tmp_path, mobil):
    env = make(5, mobil)
    td = env.reset()
    for _ in range(3):
        td["action"] = action(td)
        td = env.step(td)["next"]
    torch.save(dict(leaves(td)), tmp_path / "state.pt")
    loaded = make(5, mobil).reset()
    for name, value in torch.load(tmp_path / "state.pt", weights_only=True).items():
        loaded[name] = value
    td["action"] = action(td)
    loaded["action"] = action(loaded)
    assert same_bits(env.step(td)["next"], make(5, mobil).step(loaded)["next"]) == []


# Episodes by number, also through transforms


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
