"""The batch on NumPy arrays drives, observes, rewards and restarts exactly as the TorchRL
environment does.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ganlane.api import make_env
from ganlane.gym.base import make_rows
from ganlane.gym.native_rows import NativeRows
from ganlane.gym.tensor_rows import TensorRows
from ganlane.native.batch import NativeBatch
from ganlane.native.drivers import RuleDrivers
from ganlane.native.library import why_not
from ganlane.settings.commands import highways
from ganlane.settings.driving import EgoParameters
from ganlane.settings.env import EnvConfig
from ganlane.settings.observation import MaskParameters, ObservationConfig, RewardParameters

pytestmark = pytest.mark.skipif(why_not() is not None, reason="no C++ compiler")
ROWS = 37


def batch_of(env, mobil=True, rows=ROWS, **parts):
    return NativeBatch(
        rows,
        env.lanes,
        env.lane_width_m,
        env.vehicles,
        env.spawn_parameters(),
        env.ego,
        env.episode_parameters(),
        RuleDrivers(env.idm, mobil=env.mobil if mobil else None),
        env.recycle_share if env.recycle else None,
        **parts,
    )


def assert_equal(state, batch, masked):
    for name, value in state["vehicles"].items():
        np.testing.assert_array_equal(value.numpy(), batch.state["vehicles", name], name)
    low, high = batch.bounds
    seen = (
        state["observation"]
        .numpy()
        .clip([0.0, *[low] * (batch.observation.shape[1] - 1)], max(high, 4.0))
    )
    np.testing.assert_array_equal(seen, batch.observation)
    for name, value in state["reward_terms"].items():
        np.testing.assert_array_equal(value[:, 0].numpy(), batch.reward_terms()[name], name)
    if masked:
        np.testing.assert_array_equal(state["action_mask"].numpy(), batch.mask)


LORRIES = {"truck_share": 0.3, "truck_desired_speed_mps": (20.0, 22.0)}


@pytest.mark.parametrize(
    ("traffic", "options", "observation", "reward", "mask"),
    [
        ("idm_mobil", {"goal_m": 700.0}, "lane_view_overlap", {}, "none"),
        (
            "idm",
            {"goal_m": 700.0, "lanes": 5, "vehicles": 30, "spread_m": 500.0},
            "lane_view",
            {},
            "legal",
        ),
        (
            "idm_mobil",
            {"recycle": True, "recycle_share": 0.5, "goal_m": 900.0, **LORRIES},
            "lane_view_drift",
            {"soft_crash_behind": -5.0, "literal_low_acceleration": True, "low_acceleration": -0.2},
            "safe",
        ),
        (
            "idm_mobil",
            {
                "decision_period_s": 0.5,
                "timeout_s": 9.0,
                "ego": EgoParameters(abort_lane_change=True),
            },
            "lane_view_overlap",
            {},
            "safe",
        ),
    ],
)
def test_a_batch_gives_the_torchrl_environments_numbers(
    traffic, options, observation, reward, mask
):
    config = EnvConfig(**options)
    batch = batch_of(
        config,
        traffic == "idm_mobil",
        observation=ObservationConfig(form=observation),
        reward=RewardParameters(**reward),
        mask=MaskParameters(mask),
    )
    env = make_env(
        traffic,
        ROWS,
        env=config,
        kernel="native",
        observation=observation,
        reward=reward,
        mask=mask,
        seed=5,
    )
    state = env.reset()
    batch.start(5, np.arange(ROWS))
    assert_equal(state, batch, mask != "none")
    draw = np.random.default_rng(0)
    ended = 0
    for decision in range(60):
        actions = draw.integers(0, 3, ROWS) * (decision % 3 == 0)
        both, state = env.step_and_maybe_reset(state.set("action", torch.as_tensor(actions)))
        after = both["next"]
        stepped = batch.step(actions)
        assert_equal(after, batch, mask != "none")
        np.testing.assert_array_equal(after["reward"][:, 0].numpy(), stepped.reward)
        for name in ("done", "terminated", "truncated"):
            np.testing.assert_array_equal(after[name][:, 0].numpy(), batch.state[name])
        done = batch.state["done"].copy()
        ended += done.sum()
        batch.start(batch.state["seed"], batch.state["episode"] + ROWS, done)
        assert_equal(state, batch, mask != "none")
        np.testing.assert_array_equal(state["episode"].numpy(), batch.state["episode"])
    assert ended > ROWS // 2


def both_ways(traffic, rows, **options):
    """The rows of gymnasium without torch, and those behind TorchRL, on the same episodes."""
    rows_by_kernel = make_rows(traffic, rows, False, (), options)
    assert isinstance(rows_by_kernel, NativeRows)
    behind = TensorRows(highways(traffic=traffic, num_envs=rows, kernel="native", **options))
    for side in (rows_by_kernel, behind):
        side.start(3, np.arange(rows))
    return rows_by_kernel, behind


def any_commands(rows, rng):
    if not rows.actions.names:
        action = rng.uniform(-1.0, 1.0, (rows.count, 2)).astype(np.float32)
        action[:, 1] *= rng.random(rows.count) < 0.5
        return action
    return np.array([rng.choice(np.flatnonzero(allowed)) for allowed in rows.mask()])


@pytest.mark.parametrize(
    ("traffic", "options"),
    [
        ("idm_mobil", {"env": "merge", "observation": "road_view"}),
        ("idm_mobil", {"env": "exit", "observation": "road_view", "mask": "safe"}),
        ("idm_faults", {"env": "lane_drop", "observation": "lane_view", "mask": "legal"}),
        ("idm", {"env": "cut_in", "actions": "lane_speed", "mask": "safe"}),
        ("idm_mobil", {"env": "exit", "observation": "road_view", "actions": "lane_speed"}),
        ("idm_mobil", {"env": "merge", "observation": "road_view", "actions": "continuous"}),
        ("idm_mobil", {"env": "highway", "actions": "continuous"}),
    ],
)
def test_scenes_and_other_commands_are_driven_like_behind_torchrl(traffic, options):
    one, other = both_ways(traffic, ROWS, **options)
    rng = np.random.default_rng(0)
    ended = 0
    for _ in range(30):
        np.testing.assert_array_equal(one.observation(), other.observation())
        np.testing.assert_array_equal(one.mask(), other.mask())
        commands = any_commands(one, rng)
        for mine, theirs in zip(one.step(commands), other.step(commands), strict=True):
            np.testing.assert_array_equal(mine, theirs)
        mine, theirs = one.info(), other.info()
        assert mine.keys() == theirs.keys()
        for name in mine.keys() - {"reward_terms"}:
            np.testing.assert_array_equal(mine[name], theirs[name], name)
        over = mine["hard_crash"] | mine["out_of_road"] | mine["goal"] | mine["missed_exit"]
        over = over | mine["timeout"]
        ended += int(over.sum())
        if over.any():
            fresh = over.copy()
            one.restart(fresh)
            other.restart(fresh)
    assert ended > 0 or one.actions.names


def test_generated_drivers_of_a_scene_begin_alike_up_to_rounding():
    one, other = both_ways("gan_calibrated", 5, env="exit")
    for _ in range(3):
        one.step(np.zeros(5, np.int64))
        other.step(np.zeros(5, np.int64))
        np.testing.assert_allclose(one.observation(), other.observation(), atol=1e-3)
