"""Given episodes are run to their own ends.

Each is what it is alone, whatever drives in the other rows.
"""

import polars as pl
import pytest
import torch
from polars.testing import assert_frame_equal
from reference.refusals import user_error
from reference.worlds import vehicles
from torchrl.envs import StepCounter
from torchrl.envs.utils import ExplorationType, exploration_type

import ganlane
from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.evaluation import run_episodes
from ganlane.evaluation.measures import ego_at_fault
from ganlane.traffic import IdmTraffic

SEED = 4
#: Short and of different lengths: who drives at random also leaves the road and crashes.
SHORT = {"goal_m": 60.0, "kernel": "torch"}


@pytest.fixture(autouse=True)
def smaller_batches(monkeypatch):
    """Rows are left out of batches of 5, too."""
    monkeypatch.setattr("ganlane.evaluation.episodes.SMALL_BATCH", 4)


class Remade:
    """Makes an environment of any size, and remembers the sizes that were asked for."""

    def __init__(self, traffic="idm", wrap=lambda env: env, **options):
        self.options, self.wrap, self.sizes = {"traffic": traffic, **SHORT, **options}, wrap, []

    def __call__(self, rows):
        self.sizes.append(rows)
        return self.wrap(ganlane.make_env(num_envs=rows, **self.options))


def policy_of(name="random"):
    return ganlane.load_agent(name).policy


#: Sums over an episode, as its decisions give them.
SUMS = {
    "reward": "reward",
    "reward_speed": ("reward_terms", "speed"),
    "soft_crash": ("events", "soft_crash"),
    "soft_crash_behind": ("events", "soft_crash_behind"),
}


def alone(make, policy, episodes):
    """Each episode, driven with nothing beside it and counted by hand."""
    env, rows = make(1), []
    for episode in episodes:
        counters = {keys.SEED: torch.tensor([SEED]), keys.EPISODE: torch.tensor([episode])}
        state = env.reset(env.reset().empty().update(counters))
        sums, decisions = dict.fromkeys(SUMS, 0.0), 0
        while decisions == 0 or not state["done"]:
            after = env.step(policy(state))["next"]
            sums = {name: total + float(after[SUMS[name]]) for name, total in sums.items()}
            state, decisions = after, decisions + 1
        ends = [name for name in keys.END_EVENTS if state["events", name]]
        distance_m, seconds = float(state["ego", "distance"]), 0.1 * int(state[keys.STEP])
        rows.append(
            {
                "episode": episode,
                "seed": SEED,
                "reason": ends[0] if ends else "other",
                "had_soft_crash": sums["soft_crash"] > 0,
                "lane_changes": int(state["ego", "lane_changes"]),
                "distance_m": distance_m,
                "duration_s": seconds,
                "mean_speed_mps": distance_m / seconds if seconds else None,
                "decisions": decisions,
                **sums,
            }
        )
    return pl.DataFrame(rows)


def assert_as_alone(table, expected):
    """Bit for bit but for what is divided here in another order."""
    rounded = ["mean_speed_mps", "duration_s"]
    table = table.select(expected.columns)
    assert_frame_equal(table.select(rounded), expected.select(rounded))
    exact = {"check_exact": True, "check_dtypes": False}
    assert_frame_equal(table.drop(rounded), expected.drop(rounded), **exact)


def sources(recordings):
    late = {"sensors": {"position_noise_m": 2.0, "delay_s": 2.0}}
    return {
        "recycled": Remade(goal_m=90.0, recycle=True, kernel="auto"),
        "late sensors": Remade("idm_mobil", observation=late),
        "replayed": Remade({"name": "replay", "path": str(recordings)}),
        "cut short": Remade(wrap=lambda env: env.append_transform(StepCounter(max_steps=3))),
    }


@pytest.mark.parametrize("name", ["recycled", "late sensors", "replayed", "cut short"])
def test_every_episode_is_bit_for_bit_what_it_is_alone(name, three_scenes, monkeypatch):
    monkeypatch.setattr("ganlane.evaluation.episodes.CHECK_EVERY", 2)
    make, driver = sources(three_scenes)[name], "agent_idm" if name == "late sensors" else "random"
    policy, episodes = policy_of(driver), [*range(30, 34), 7, 3]
    expected, modes = alone(make, policy, episodes), set()
    look = policy.register_forward_hook(
        lambda *_: modes.add((exploration_type(), torch.is_grad_enabled()))
    )
    assert_as_alone(run_episodes(make(3), policy, episodes, SEED), expected)
    make.sizes.clear()
    seen = []
    wide = run_episodes(
        make(5), policy, episodes, SEED, lambda *counts: seen.append(counts), make_smaller=make
    )
    assert_as_alone(wide, expected)
    look.remove()
    # No noise, and no gradients; progress counts up.
    assert modes == {(ExplorationType.DETERMINISTIC, False)}
    assert seen == sorted(seen)
    assert seen[-1] == (6, 6)
    assert make.sizes[0] == 5
    assert (expected["reason"] == "other").any() == (name == "cut short")


def test_episodes_stay_in_their_rows_unless_the_policy_says_that_they_may_move():
    make, policy = Remade(), policy_of()
    policy.rows_must_stay = True
    run_episodes(make(6), policy, range(6), SEED, make_smaller=make)
    assert make.sizes == [6]


class Watchful(IdmTraffic):
    """Holds the episode of every row outside the tensordict, as a foreign simulator does."""

    rows_must_stay = True

    def __init__(self):
        super().__init__()
        self.seen = None
        self.begun = []

    def forward(self, tensordict):
        now = torch.stack([tensordict[name] for name in (keys.SEED, keys.EPISODE)], dim=1)
        fresh = tensordict[keys.STEP] == 0
        if self.seen is not None:
            assert now.shape == self.seen.shape
            assert bool((fresh | (now == self.seen).all(1)).all()), "an episode changed its row"
        self.begun += now[fresh, 1].tolist()
        self.seen = now
        return super().forward(tensordict)


def test_rows_stay_and_are_never_driven_on_where_the_traffic_holds_something_per_row():
    make = Remade(Watchful)
    env = make(6)
    table = run_episodes(env, policy_of(), range(12), SEED, make_smaller=make)
    assert make.sizes == [6]
    moved = table.filter(pl.col("duration_s") > 0)["episode"]
    assert set(moved) <= set(env.base_env.traffic.begun) <= set(range(12))
    expected = run_episodes(Remade()(6), policy_of(), range(12), SEED)
    assert_frame_equal(table, expected, check_exact=True)


class Stubborn(HighwayEnv):
    """Goes on with episodes of its own choice."""

    def _reset(self, tensordict, next_episode=None, **kwargs):
        return super()._reset(tensordict, **kwargs)


def test_no_episodes_and_an_environment_that_ignores_those_it_is_given_are_refused():
    for kind, episodes, told in (
        (Stubborn, [0, 1, 5, 9], "next_episode"),
        (HighwayEnv, [], "episodes"),
    ):
        with user_error(told):
            run_episodes(kind(IdmTraffic(), 2), policy_of(), episodes, seed=0)


@pytest.mark.parametrize(
    ("ego", "other", "at_fault"),
    [
        ({"speed": 20.0}, {"x": 4.4, "speed": 10.0}, True),  # into the one ahead
        ({}, {"x": -4.4, "speed": 30.0}, False),  # struck from behind
        ({}, {"y": 2.4, "heading": -0.1}, False),  # the other changes lanes into the ego
        ({}, {"x": 4.0, "y": 2.2, "heading": -0.1}, False),  # and ahead of it, too
        # moving away, faster
        ({}, {"x": -4.2, "y": 1.0, "speed": 30.0, "heading": 0.1}, False),
        ({"heading": 0.1}, {"y": 2.4}, True),  # the ego into the other
        ({"heading": 0.1}, {"y": 2.4, "heading": -0.05}, True),  # both, the ego faster
        ({"heading": -0.05}, {"y": -2.4, "heading": 0.1}, False),  # both, the other faster
        ({"speed": 30.0}, {"x": 10.0}, False),  # nobody was hit
    ],
)
def test_who_moved_into_whom(ego, other, at_fault):
    assert bool(ego_at_fault(vehicles(ego, other))) == at_fault
