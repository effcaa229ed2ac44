"""Given episodes are run to their own ends.

Each is what it is alone, whatever drives in the other rows.
"""

from __future__ import annotations

import polars as pl
import pytest
import torch
from evaluation_toy_env import ToyEnv, always, length, reason
from polars.testing import assert_frame_equal
from reference.refusals import user_error
from reference.scene_csv import write_scene_csv
from reference.synthetic import SyntheticTraffic, synthetic_scenes
from reference.worlds import vehicles
from tensordict.nn import TensorDictModule
from torchrl.envs import StepCounter
from torchrl.envs.utils import ExplorationType, exploration_type, step_mdp

from ganlane import keys
from ganlane.build import make_driver, make_env, make_traffic
from ganlane.evaluation import run_episodes
from ganlane.evaluation.episodes import ScriptedPolicy
from ganlane.evaluation.measures import ego_at_fault
from ganlane.settings.env import EnvConfig
from ganlane.settings.observation import ObservationConfig, SensorParameters
from ganlane.settings.traffic import (
    IdmMobilTrafficConfig,
    IdmTrafficConfig,
    ReplayTrafficConfig,
)
from ganlane.traffic import IdmTraffic

SEED = 4
#: Short and of different lengths: who drives at random also leaves the road and crashes.
SHORT = EnvConfig(goal_m=60.0, kernel="torch")


def test_each_row_tells_what_the_episode_was():
    frame = run_episodes(
        ToyEnv(4),
        always(1),
        range(10),
        seed=5,
    )
    assert frame["episode"].to_list() == list(range(10))
    assert frame["seed"].to_list() == [5] * 10
    for row in frame.iter_rows(named=True):
        decisions = length(5, row["episode"])
        goal = 100.0 if reason(row["episode"]) == "goal" else 0.0
        assert row["reason"] == reason(row["episode"])
        assert row["decisions"] == row["lane_changes"] == decisions
        assert row["reward_speed"] == pytest.approx(decisions * (row["episode"] + 1))
        assert row["reward_goal"] == goal
        assert row["reward"] == pytest.approx(row["reward_speed"] + goal)
        assert row["soft_crash"] == decisions // 3
        assert row["soft_crash_behind"] == 2 * (decisions // 3)
        assert row["had_soft_crash"] == (decisions >= 3)
        assert row["distance_m"] == 20.0 * decisions
        assert row["duration_s"] == pytest.approx(decisions)
        assert row["mean_speed_mps"] == pytest.approx(20.0)


def test_the_policy_acts_deterministically_and_without_gradients_while_progress_counts_up():
    modes, seen = set(), []

    def look(step):
        modes.add((exploration_type(), torch.is_grad_enabled()))
        return torch.zeros_like(step)

    policy = TensorDictModule(
        look,
        in_keys=["step"],
        out_keys=["action"],
    )
    run_episodes(
        ToyEnv(4),
        policy,
        range(6),
        seed=0,
        on_progress=lambda done, total: seen.append((done, total)),
    )
    assert modes == {(ExplorationType.DETERMINISTIC, False)}
    assert seen == sorted(seen)
    assert seen[-1] == (6, 6)


class Remade:
    """Makes an environment of any size, and remembers the sizes that were asked for."""

    def __init__(
        self,
        traffic,
        env=SHORT,
        sensors=None,
        wrap=lambda env: env,
    ):
        self.traffic, self.env, self.wrap = make_traffic(traffic, env), env, wrap
        self.observation = ObservationConfig(sensors=sensors)
        self.sizes = []

    def __call__(self, rows):
        self.sizes.append(rows)
        return self.wrap(
            make_env(
                self.traffic,
                self.env,
                self.observation,
                num_envs=rows,
            )
        )


def alone(
    make,
    policy,
    episodes,
):
    """Decisions, reward, distance and end of each episode, driven with nothing beside it and
    counted by hand.
    """
    env, rows = make(1), []
    for episode in episodes:
        counters = {keys.SEED: torch.tensor([SEED]), keys.EPISODE: torch.tensor([episode])}
        state = env.reset(env.reset().empty().update(counters))
        reward, decisions, done = 0.0, 0, False
        while not done:
            after = env.step(policy(state))
            state, decisions, done = step_mdp(after), decisions + 1, bool(after["next", "done"])
            reward += float(after["next", "reward"])
        ends = [name for name in keys.END_EVENTS if bool(state["events", name])]
        distance = float(state["ego", "distance"])
        rows.append((episode, decisions, reward, distance, ends[0] if ends else "other"))
    return pl.DataFrame(
        rows,
        schema=[
            "episode",
            "decisions",
            "reward",
            "distance_m",
            "reason",
        ],
        orient="row",
    )


def compared(table):
    return table.select(
        "episode",
        "decisions",
        "reward",
        "distance_m",
        "reason",
    )


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    path = tmp_path_factory.mktemp("recordings") / "scenes.csv"
    write_scene_csv(synthetic_scenes(SyntheticTraffic(scenes=3, seconds=7.0), seed=0), path)
    return ReplayTrafficConfig(path=str(path))


def sources(recordings):
    return {
        "recycled": Remade(IdmTrafficConfig(), EnvConfig(goal_m=90.0, recycle=True)),
        "late sensors": Remade(
            IdmMobilTrafficConfig(), sensors=SensorParameters(position_noise_m=2.0, delay_s=2.0)
        ),
        "replayed": Remade(recordings),
        "cut short": Remade(
            IdmTrafficConfig(), wrap=lambda env: env.append_transform(StepCounter(max_steps=3))
        ),
    }


@pytest.mark.parametrize(
    "name",
    [
        "recycled",
        "late sensors",
        "replayed",
        "cut short",
    ],
)
def test_every_episode_is_bit_for_bit_what_it_is_alone(
    name,
    recordings,
    monkeypatch,
):
    monkeypatch.setattr("ganlane.evaluation.episodes.CHECK_EVERY", 2)
    make, driver = sources(recordings)[name], "agent_idm" if name == "late sensors" else "random"
    policy, episodes = make_driver(driver, make.env).policy, [*range(30, 47), 7, 3]
    expected = alone(make, policy, episodes)
    assert_frame_equal(
        compared(
            run_episodes(
                make(5),
                policy,
                episodes,
                SEED,
            )
        ),
        expected,
        check_exact=True,
    )
    make.sizes.clear()
    wide = run_episodes(
        make(17),
        policy,
        episodes,
        SEED,
        make_smaller=make,
    )
    assert_frame_equal(compared(wide), expected, check_exact=True)
    assert make.sizes[0] == 17
    assert (expected["reason"] == "other").any() == (name == "cut short")


@pytest.mark.parametrize("may_move", [True, False])
def test_the_last_episodes_move_to_ever_smaller_environments_if_the_policy_says_that_they_may(
    may_move,
):
    sizes, policy = [], always(1)
    if may_move:
        policy.rows_must_stay = False
    frame = run_episodes(
        ToyEnv(64),
        policy,
        range(64),
        0,
        make_smaller=lambda n: sizes.append(n) or ToyEnv(n),
    )
    assert frame["decisions"].to_list() == [length(0, e) for e in range(64)]
    # Episodes last 3 to 13 decisions; after 8 of them those of 9 to 13 are left.
    assert sizes == ([sum(length(0, e) > 8 for e in range(64))] if may_move else [])


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
    traffic, make = Watchful(), Remade(IdmTrafficConfig())
    env, policy = make_env(traffic, SHORT, num_envs=17), make_driver("random", SHORT).policy
    table = run_episodes(
        env,
        policy,
        range(30),
        SEED,
        make_smaller=lambda rows: pytest.fail("moved"),
    )
    moved = table.filter(pl.col("duration_s") > 0)["episode"]
    assert set(moved) <= set(traffic.begun) <= set(range(30))
    assert_frame_equal(
        table,
        run_episodes(
            make(17),
            policy,
            range(30),
            SEED,
        ),
        check_exact=True,
    )


def test_no_episodes_and_an_environment_that_ignores_those_it_is_given_are_refused():
    class Stubborn(ToyEnv):
        def _reset(
            self,
            tensordict=None,
            next_episode=None,
            **kwargs,
        ):
            return super()._reset(tensordict, **kwargs)

    with user_error("next_episode"):
        run_episodes(
            Stubborn(2),
            always(0),
            [0, 1, 5, 9],
            seed=0,
        )
    with user_error("episodes"):
        run_episodes(
            ToyEnv(2),
            always(0),
            [],
            seed=0,
        )


def test_an_episode_comes_back_from_its_actions():
    config = EnvConfig(goal_m=90.0)
    env = make_env(make_traffic(IdmMobilTrafficConfig(), config), config, num_envs=2)
    policy = make_driver("random_legal", config).policy
    table = run_episodes(
        env,
        policy,
        [4, 1, 7],
        seed=3,
        actions=True,
    )
    assert table["actions"].str.len_chars().to_list() == table["decisions"].to_list()
    script = ScriptedPolicy(dict(table.select("episode", "actions").iter_rows()))
    assert_frame_equal(
        run_episodes(
            env,
            script,
            [4, 1, 7],
            seed=3,
            actions=True,
        ),
        table,
    )


@pytest.mark.parametrize(
    ("ego", "other", "at_fault"),
    [
        ({"speed": 20.0}, {"x": 4.4, "speed": 10.0}, True),  # into the one ahead
        ({}, {"x": -4.4, "speed": 30.0}, False),  # struck from behind
        ({}, {"y": 2.4, "heading": -0.1}, False),  # the other changes lanes into the ego
        (
            {},
            {
                "x": 4.0,
                "y": 2.2,
                "heading": -0.1,
            },
            False,
        ),  # and ahead of it, too
        (
            {},
            {
                "x": -4.2,
                "y": 1.0,
                "speed": 30.0,
                "heading": 0.1,
            },
            False,
        ),  # moving away, faster
        ({"heading": 0.1}, {"y": 2.4}, True),  # the ego into the other
        ({"heading": 0.1}, {"y": 2.4, "heading": -0.05}, True),  # both, the ego faster
        ({"heading": -0.05}, {"y": -2.4, "heading": 0.1}, False),  # both, the other faster
        ({"speed": 30.0}, {"x": 10.0}, False),  # nobody was hit
    ],
)
def test_who_moved_into_whom(
    ego,
    other,
    at_fault,
):
    same = {
        "x": 0.0,
        "y": 0.0,
        "target_lane": 0,
    }
    assert bool(ego_at_fault(vehicles({**same, **ego}, {**same, **other}))) == at_fault
