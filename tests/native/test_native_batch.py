"""The batch on NumPy arrays drives, observes, rewards and restarts exactly as the TorchRL
environment does.
"""

import numpy as np
import pytest
from reference.kernels import MIXED

from ganlane.gym.base import make_rows
from ganlane.gym.native_rows import NativeRows
from ganlane.gym.tensor_rows import TensorRows
from ganlane.keys import END_EVENTS
from ganlane.settings.commands import highways

pytestmark = pytest.mark.kernel
ROWS = 37


LORRIES = {"truck_share": 0.3, "truck_desired_speed_mps": (20.0, 22.0)}
FLOW = {"vph": 1200.0, "ramp_vph": 600.0, "slots": 20}
OTHER_REWARD = {"soft_crash_behind": -5.0, "literal_low_acceleration": True}
OTHER_REWARD |= {"low_acceleration": -0.2}


def both_ways(traffic, rows, **options):
    """The rows of gymnasium without torch, and those behind TorchRL, on the same episodes."""
    one = make_rows(traffic, rows, False, (), options)
    assert isinstance(one, NativeRows)
    other = TensorRows(highways(traffic=traffic, num_envs=rows, kernel="native", **options))
    for side in (one, other):
        side.start(3, np.arange(rows))
    return one, other


def any_commands(rows, rng):
    if not rows.actions.names:
        action = rng.uniform(-1.0, 1.0, (rows.count, 2)).astype(np.float32)
        action[:, 1] *= rng.random(rows.count) < 0.5
        return action
    return np.array([rng.choice(np.flatnonzero(allowed)) for allowed in rows.mask()])


@pytest.mark.parametrize(
    ("traffic", "options"),
    [
        *((traffic, {}) for traffic in ("idm_random", "human", "gan", "gan_calibrated", MIXED)),
        *(({"name": name, "blind_share": 0.5}, {}) for name in ("gan", "idm")),
        ("idm_mobil", {"env": "merge", "observation": "road_view"}),
        ("idm_mobil", {"env": "exit", "observation": "road_view", "mask": "safe"}),
        ("idm_faults", {"env": "lane_drop", "observation": "lane_view", "mask": "legal"}),
        *(
            ("idm", {"env": env, "timeout_s": 9.0, "flow": {**FLOW, "exit_share": exit_share}})
            for env, exit_share in (("merge", 0.0), ("weave", 0.3))
        ),
        ("idm", {"env": "cut_in", "actions": "lane_speed", "mask": "foresight"}),
        ("idm_mobil", {"env": "merge", "observation": "road_view", "actions": "continuous"}),
        ("idm_mobil", {"goal_m": 300.0, "observation": "lane_view_overlap"}),
        (
            "idm",
            {"lanes": 5, "vehicles": 30, "spread_m": 500.0, "mask": "legal", "goal_m": 300.0}
            | {"observation": "lane_view"},
        ),
        (
            "idm_mobil",
            {"recycle": True, "recycle_share": 0.5, "goal_m": 300.0, "mask": "foresight", **LORRIES}
            | {"observation": "lane_view_drift", "reward": OTHER_REWARD},
        ),
        (
            "idm_mobil",
            {"decision_period_s": 0.5, "timeout_s": 9.0, "mask": "safe"}
            | {"ego": {"abort_lane_change": True}},
        ),
    ],
)
def test_scenes_and_other_commands_are_driven_like_behind_torchrl(traffic, options):
    one, other = both_ways(traffic, ROWS, **options)
    rng = np.random.default_rng(0)
    ended = 0
    for _ in range(20):
        np.testing.assert_array_equal(one.observation(), other.observation())
        np.testing.assert_array_equal(one.mask(), other.mask())
        commands = any_commands(one, rng)
        np.testing.assert_equal(one.step(commands), other.step(commands))
        info = one.info()
        np.testing.assert_equal(info, other.info())
        for name, value in other.now()["vehicles"].items():
            np.testing.assert_array_equal(one.batch.state["vehicles", name], value.numpy(), name)
        over = np.any([info[name] for name in END_EVENTS[:-1]], axis=0)
        ended += int(over.sum())
        if over.any():
            one.restart(over)
            other.restart(over)
    assert ended > 0 or one.actions.names


def test_generated_drivers_of_a_scene_begin_alike_up_to_rounding():
    one, other = both_ways("gan_calibrated", 5, env="exit")
    for _ in range(3):
        one.step(np.zeros(5, np.int64))
        other.step(np.zeros(5, np.int64))
        np.testing.assert_allclose(one.observation(), other.observation(), atol=1e-3)
