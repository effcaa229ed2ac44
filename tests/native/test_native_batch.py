"""The batch on NumPy arrays drives, observes, rewards and restarts exactly as the TorchRL
environment does.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ganlane.api import make_env
from ganlane.native.batch import NativeBatch
from ganlane.native.drivers import RuleDrivers
from ganlane.native.library import why_not
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
