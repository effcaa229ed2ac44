"""stable-baselines3: the batch is a VecEnv.

Algorithms train on it unchanged, and their policies are evaluated.
"""

import json
import warnings

import numpy as np
import pytest
import torch
from reference.refusals import user_error

sb3_contrib = pytest.importorskip("sb3_contrib", reason="the extra sb3 is not installed")

# ruff: noqa: E402 - behind the skip
import gymnasium
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecCheckNan, VecFrameStack, VecNormalize
from torchrl.envs.transforms import ObservationNorm

import ganlane
import ganlane.sb3
from ganlane.build import make_driver
from ganlane.evaluation import episodes as evaluation_of_episodes
from ganlane.settings.env import EnvConfig

ROWS = 4
SHORT = {"goal_m": 150.0}
#: Small networks and buffers: a test trains for moments.
QUICK = {
    PPO: {"n_steps": 16, "batch_size": 32},
    sb3_contrib.MaskablePPO: {"n_steps": 16, "batch_size": 32},
    sb3_contrib.RecurrentPPO: {
        "n_steps": 16,
        "batch_size": 32,
        "policy_kwargs": {"lstm_hidden_size": 8},
    },
    DQN: {"learning_starts": 32, "batch_size": 16, "buffer_size": 500},
}
#: Episodes of a comparison, one or two in each row.
EPISODES = 6
#: Dense traffic and a desired speed far above it, so that drivers differ in what they earn.
BUSY = {"goal_m": 250.0, "stream": "report", "seed": 3}


def short_episodes(**options):
    return ganlane.sb3.make_vec_env("idm", num_envs=ROWS, **{"seed": 0, **SHORT, **options})


def untrained(algorithm, env):
    policy = "MlpLstmPolicy" if algorithm is sb3_contrib.RecurrentPPO else "MlpPolicy"
    return algorithm(policy, env, seed=0, device="cpu", **QUICK[algorithm])


def drive(env, steps):
    """Observations, rewards, ends and infos of so many steps in which all rows keep their lanes."""
    env.reset()
    return [env.step(np.zeros(ROWS, dtype=np.int64)) for _ in range(steps)]


def test_the_info_of_a_row_that_ends_holds_its_statistics_and_its_last_observation():
    returns = np.zeros(ROWS)
    lengths = np.zeros(ROWS, dtype=int)
    ends = 0
    for observation, reward, done, infos in drive(short_episodes(), 40):
        returns += reward
        lengths += 1
        assert all(info == {} for info, ended in zip(infos, done) if not ended)
        for row in np.flatnonzero(done):
            info = infos[row]
            assert info["episode"]["r"] == pytest.approx(returns[row], abs=1e-4)
            assert info["episode"]["l"] == lengths[row]
            assert info["terminal_observation"].shape == observation[row].shape
            assert not np.array_equal(info["terminal_observation"], observation[row])
            assert info["goal"]
            assert not info["TimeLimit.truncated"]
        ends += done.sum()
        returns[done] = 0.0
        lengths[done] = 0
    assert ends > ROWS


def test_masks_are_given_to_sb3_contrib_by_row():
    env = short_episodes(mask="safe")
    env.reset()
    assert env.has_attr("action_masks")
    masks = np.stack(env.env_method("action_masks"))
    assert masks.shape == (ROWS, 3)
    assert np.array_equal(masks, env.action_masks())
    assert masks[:, 0].all()
    assert np.array_equal(np.stack(env.env_method("action_masks", indices=[2])), masks[2:3])


def test_pictures_of_all_rows_are_tiled():
    env = short_episodes(render_mode="rgb_array")
    env.reset()
    height, width, _ = env.get_images()[0].shape
    assert env.render().shape == (2 * height, 2 * width, 3)
    with user_error("render_mode"):
        short_episodes().get_images()


def test_attributes_are_those_of_the_batch_and_cannot_be_set():
    env = short_episodes()
    assert env.get_attr("num_envs") == [ROWS] * ROWS
    assert not env.has_attr("no_such_thing")
    assert env.env_is_wrapped(Monitor) == [True] * ROWS
    assert env.env_is_wrapped(VecNormalize) == [False] * ROWS
    with user_error("make_vec_env"):
        env.set_attr("lanes", 4)
    with user_error("call one of them"):
        env.env_method("no_such_method")
    with user_error("seed=-1"):
        env.seed(-1)
    env.close()


@pytest.mark.parametrize("algorithm", QUICK, ids=lambda kind: kind.__name__)
def test_the_algorithm_trains_unchanged_and_its_policy_can_be_evaluated(algorithm):
    env = short_episodes(mask="safe")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = untrained(algorithm, env).learn(128)
        if algorithm is not sb3_contrib.MaskablePPO:
            returns, lengths = evaluate_policy(
                model, short_episodes(), n_eval_episodes=4, return_episode_rewards=True
            )
            assert len(returns) == len(lengths) == 4
    assert model.ep_info_buffer
    driver = ganlane.sb3.driver(model)
    table = ganlane.api.evaluate([driver, "mobil"], ["idm"], 3, mask="safe", **SHORT)
    assert table["agent"].to_list() == [algorithm.__name__.lower(), "mobil"]
    assert table["episodes"].to_list() == [3, 3]
    assert table["out_of_road"].to_list() == [0, 0]


def busy_highways(**options):
    return ganlane.sb3.make_vec_env("idm_mobil", num_envs=ROWS, **{**BUSY, **options})


def sharp(model):
    """``model`` with large random weights: it takes all actions, by what it reads."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator))
    return model


def returns_in_the_own_loop(model, env):
    """Returns of the episodes 0 to EPISODES - 1, as stable-baselines3's documentation drives."""
    if isinstance(env, VecNormalize):
        env.training = False
    env.seed(BUSY["seed"])
    observation = env.reset()
    state, start = None, np.ones(ROWS, dtype=bool)
    returns = {}
    while not set(range(EPISODES)) <= returns.keys():
        masks = {}
        if isinstance(model, sb3_contrib.MaskablePPO):
            masks["action_masks"] = np.stack(env.env_method("action_masks"))
        action, state = model.predict(observation, state, start, deterministic=True, **masks)
        observation, _, start, infos = env.step(action)
        for info in infos:
            if info:
                returns[info["episode_number"]] = info["episode"]["r"]
    return [returns[number] for number in range(EPISODES)]


def returns_in_the_evaluation(driver, **options):
    keys = {**BUSY, "num_envs": ROWS, **options}
    table = ganlane.api.evaluate([driver], ["idm_mobil"], EPISODES, per_episode=True, **keys)
    return table.sort("episode")["reward"].to_list()


def normalised(env):
    """Behind statistics that are far from 0 and 1."""
    env = VecNormalize(env, clip_obs=2.0)
    env.reset()
    for action in np.random.default_rng(0).integers(0, 3, (50, ROWS)):
        env.step(action)
    return env


@pytest.mark.parametrize(
    ("algorithm", "options", "wrap"),
    [
        (PPO, {}, None),
        (PPO, {"observation": {"name": "table3_progress", "range_m": 60.0}}, VecCheckNan),
        (PPO, {}, normalised),
        (PPO, {"mask": "safe"}, None),
        (sb3_contrib.RecurrentPPO, {"observation": "table3_progress"}, normalised),
        (sb3_contrib.MaskablePPO, {"mask": "safe"}, None),
    ],
    ids=lambda part: getattr(part, "__name__", None),
)
def test_an_evaluation_prints_the_reward_of_the_users_own_loop(
    algorithm, options, wrap, monkeypatch
):
    # Running episodes move to smaller batches as early as they may.
    monkeypatch.setattr(evaluation_of_episodes, "SMALL_BATCH", 1)
    env = busy_highways(**options)
    env = wrap(env) if wrap else env
    model = sharp(untrained(algorithm, env))
    expected = returns_in_the_own_loop(model, env)
    assert np.ptp(expected) > 1.0
    # In another number of rows than the loop has.
    printed = returns_in_the_evaluation(ganlane.sb3.driver(model), num_envs=ROWS - 1)
    assert printed == pytest.approx(expected, abs=1e-3)


def test_a_single_environment_of_gymnasium_says_what_the_model_reads():
    options = {"observation": "table3_progress", **SHORT}
    model = untrained(DQN, gymnasium.make("ganlane/Highway-v0", **options))
    assert ganlane.sb3.driver(model).observation.form == "table3_progress"


def halved():
    return ObservationNorm(0.0, 0.5, in_keys=["observation"])


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("VecFrameStack", lambda: VecFrameStack(short_episodes(), 2)),
        ("VecNormalize", lambda: VecNormalize(VecNormalize(short_episodes()))),
        ("ObservationNorm", lambda: short_episodes(transforms=[halved()])),
        (
            "FlattenObservation",
            lambda: gymnasium.wrappers.FlattenObservation(gymnasium.make("ganlane/Highway-v0")),
        ),
        ("CartPoleEnv", lambda: gymnasium.make("CartPole-v1")),
    ],
)
def test_what_a_driver_cannot_repeat_is_refused_by_name(name, make):
    model = DQN("MlpPolicy", make(), device="cpu", **QUICK[DQN])
    with user_error(f"{name} stands between"):
        ganlane.sb3.driver(model)


def test_a_masked_model_that_could_turn_back_without_a_mask_is_refused():
    env = short_episodes(env={"ego": {"abort_lane_change": True}})
    with user_error("train it with mask='legal'"):
        ganlane.sb3.driver(untrained(sb3_contrib.MaskablePPO, env))


@pytest.mark.parametrize(
    ("algorithm", "options", "wrap"),
    [
        (PPO, {"observation": "table3_progress"}, normalised),
        (sb3_contrib.MaskablePPO, {"mask": {"name": "safe", "safe_deceleration": 3.0}}, None),
        (DQN, {}, None),
    ],
    ids=["normalised", "masked", "dqn"],
)
def test_a_stored_driver_drives_as_before(algorithm, options, wrap, tmp_path):
    env = busy_highways(**options)
    env = wrap(env) if wrap else env
    driver = ganlane.sb3.driver(sharp(untrained(algorithm, env)))
    driver.save(tmp_path / "ppo")
    model = algorithm.load(tmp_path / "ppo")
    again = ganlane.sb3.driver(model, "again", stored=tmp_path / "ppo")
    assert (again.name, again.observation, again.mask) == ("again", driver.observation, driver.mask)
    returns = returns_in_the_evaluation(driver)
    assert returns_in_the_evaluation(again) == returns
    # By its weights alone, as `ganlane benchmark ppo.zip` loads it.
    by_weights = make_driver(str(tmp_path / "ppo.zip"), EnvConfig())
    assert (by_weights.observation, by_weights.mask) == (driver.observation, driver.mask)
    assert returns_in_the_evaluation(by_weights) == returns
    # And once more from what was loaded.
    again.save(tmp_path / "copy.zip")
    first, second = (
        json.loads((tmp_path / f"{name}.zip.json").read_text())["reads"] for name in ("ppo", "copy")
    )
    assert first == second


def test_a_model_of_which_nothing_says_what_it_reads_is_refused(tmp_path):
    model = untrained(PPO, short_episodes())
    ganlane.sb3.driver(model).save(tmp_path / "ppo.zip")
    loaded = PPO.load(tmp_path / "ppo.zip")
    with user_error(r"PPO has no environment.*PPO\.load\(path, env="):
        ganlane.sb3.driver(loaded)
    with user_error(r"none\.zip\.json: .*No such file"):
        ganlane.sb3.driver(loaded, stored=tmp_path / "none")


def test_an_environment_that_does_not_fit_the_model_is_refused_in_one_sentence():
    table = {"observation": "table3"}
    driver = ganlane.sb3.driver(untrained(PPO, short_episodes(**table)))
    with user_error(r"PPO: it reads observations of shape \[\d+\], but"):
        ganlane.api.evaluate([driver], ["idm"], 2, vehicles=5, **SHORT)
    masked = ganlane.sb3.driver(untrained(sb3_contrib.MaskablePPO, short_episodes()))
    with user_error("no action_mask"):
        ganlane.make_env("idm").rollout(2, masked.policy)


@pytest.mark.parametrize("actions", ["lane", "lane_speed", "continuous"])
@pytest.mark.parametrize("scene", ["highway", "merge"])
def test_the_checker_of_stable_baselines3_warns_of_no_form_of_actions(actions, scene):
    from stable_baselines3.common.env_checker import check_env

    env = gymnasium.make("ganlane/Highway-v0", env=scene, actions=actions)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, warn=True, skip_render_check=True)


def test_a_model_of_continuous_actions_drives_in_a_table_beside_mobil(tmp_path):
    from stable_baselines3 import SAC

    options = {"env": "merge", "goal_m": 300.0}
    env = ganlane.sb3.make_vec_env("idm", num_envs=2, seed=0, actions="continuous", **options)
    model = SAC("MlpPolicy", env, learning_starts=10, batch_size=8, seed=0).learn(20)
    driver = ganlane.sb3.driver(model)
    table = ganlane.api.evaluate([driver, "mobil"], ["idm"], 2, **options)
    assert table["agent"].to_list() == ["sac", "mobil"]
    driver.save(tmp_path / "sac")
    again = ganlane.sb3.driver(SAC.load(tmp_path / "sac"), stored=tmp_path / "sac")
    assert again.actions == driver.actions
