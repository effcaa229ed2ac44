"""stable-baselines3: the batch is a VecEnv.

Algorithms train on it unchanged, and their policies are evaluated.
"""

import json

import numpy as np
import pytest
import torch
from reference.refusals import user_error

sb3_contrib = pytest.importorskip("sb3_contrib", reason="the extra sb3 is not installed")

# ruff: noqa: E402 - behind the skip
import gymnasium
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecCheckNan, VecFrameStack, VecNormalize
from torchrl.envs.transforms import ObservationNorm

import ganlane
import ganlane.sb3

ROWS = 4
SHORT = {"goal_m": 150.0}
ON_POLICY = {"n_steps": 16, "batch_size": 32}
#: Small networks and buffers: a test trains for moments.
QUICK = {
    PPO: ON_POLICY,
    sb3_contrib.MaskablePPO: ON_POLICY,
    sb3_contrib.RecurrentPPO: {**ON_POLICY, "policy_kwargs": {"lstm_hidden_size": 8}},
    DQN: {"learning_starts": 32, "batch_size": 16, "buffer_size": 500},
    SAC: {"buffer_size": 500},
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


def test_the_info_of_a_row_that_ends_holds_its_statistics_and_its_last_observation():
    env = short_episodes()
    env.reset()
    returns, lengths, ends = np.zeros(ROWS), np.zeros(ROWS, int), 0
    for _ in range(40):
        observation, reward, done, infos = env.step(np.zeros(ROWS, int))
        returns += reward
        lengths += 1
        assert all(info == {} for info, ended in zip(infos, done) if not ended)
        for row in np.flatnonzero(done):
            info = infos[row]
            assert info["episode"]["r"] == pytest.approx(returns[row], abs=1e-4)
            assert info["episode"]["l"] == lengths[row]
            assert info["terminal_observation"].shape == observation[row].shape
            assert not np.array_equal(info["terminal_observation"], observation[row])
            assert info["goal"] > info["TimeLimit.truncated"]
        ends += done.sum()
        returns[done] = lengths[done] = 0
    assert ends > ROWS


def test_masks_are_given_to_sb3_contrib_by_row():
    env = short_episodes(mask="safe")
    env.reset()
    assert env.has_attr("action_masks")
    masks = env.action_masks()
    assert masks.shape == (ROWS, 3)
    assert masks[:, 0].all()
    np.testing.assert_array_equal(env.env_method("action_masks"), masks)
    np.testing.assert_array_equal(env.env_method("action_masks", indices=[2]), masks[2:3])


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


@pytest.mark.parametrize(
    "algorithm",
    [PPO, DQN, sb3_contrib.MaskablePPO, sb3_contrib.RecurrentPPO],
    ids=lambda kind: kind.__name__,
)
@pytest.mark.filterwarnings("error")
def test_the_algorithm_trains_unchanged_and_its_policy_can_be_evaluated(algorithm):
    model = untrained(algorithm, short_episodes(mask="safe")).learn(128)
    if algorithm is not sb3_contrib.MaskablePPO:
        returns, lengths = evaluate_policy(
            model, short_episodes(), n_eval_episodes=4, return_episode_rewards=True
        )
        assert len(returns) == len(lengths) == 4
    assert model.ep_info_buffer
    drivers = [ganlane.sb3.driver(model), "mobil"]
    table = ganlane.api.evaluate(drivers, ["idm"], 3, mask="safe", **SHORT)
    assert table["agent"].to_list() == [algorithm.__name__.lower(), "mobil"]
    assert table["episodes"].to_list() == [3, 3]
    assert table["out_of_road"].to_list() == [0, 0]


def sharp(algorithm, options, wrap):
    """A model on busy highways with large random weights: it takes all actions, as it reads."""
    env = ganlane.sb3.make_vec_env("idm_mobil", num_envs=ROWS, **BUSY, **options)
    model = untrained(algorithm, wrap(env) if wrap else env)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator))
    return model


def returns_in_the_own_loop(model):
    """Returns of the episodes 0 to EPISODES - 1, as stable-baselines3's documentation drives."""
    env = model.get_env()
    env.training = False
    env.seed(BUSY["seed"])
    observation = env.reset()
    state, start, returns, masks = None, np.ones(ROWS, dtype=bool), {}, {}
    while not set(range(EPISODES)) <= returns.keys():
        if isinstance(model, sb3_contrib.MaskablePPO):
            masks = {"action_masks": np.stack(env.env_method("action_masks"))}
        action, state = model.predict(observation, state, start, deterministic=True, **masks)
        observation, _, start, infos = env.step(action)
        returns |= {info["episode_number"]: info["episode"]["r"] for info in infos if info}
    return [returns[number] for number in range(EPISODES)]


def returns_in_the_evaluation(driver, rows=ROWS):
    table = ganlane.api.evaluate(
        [driver], ["idm_mobil"], EPISODES, per_episode=True, num_envs=rows, **BUSY
    )
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
    monkeypatch.setattr("ganlane.evaluation.episodes.SMALL_BATCH", 1)
    model = sharp(algorithm, options, wrap)
    expected = returns_in_the_own_loop(model)
    assert np.ptp(expected) > 1.0
    # In another number of rows than the loop has.
    printed = returns_in_the_evaluation(ganlane.sb3.driver(model), ROWS - 1)
    assert printed == pytest.approx(expected, abs=1e-3)


def test_a_single_environment_of_gymnasium_says_what_the_model_reads():
    options = {"observation": "table3_progress", **SHORT}
    model = untrained(DQN, gymnasium.make("ganlane/Highway-v0", **options))
    assert ganlane.sb3.driver(model).observation.form == "table3_progress"


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("VecFrameStack", lambda: VecFrameStack(short_episodes(), 2)),
        ("VecNormalize", lambda: VecNormalize(VecNormalize(short_episodes()))),
        (
            "ObservationNorm",
            lambda: short_episodes(transforms=[ObservationNorm(0.0, 0.5, in_keys=["observation"])]),
        ),
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
        (SAC, {"actions": "continuous"}, None),
    ],
    ids=["normalised", "masked", "dqn", "sac"],
)
def test_a_stored_driver_drives_as_before(algorithm, options, wrap, tmp_path):
    driver = ganlane.sb3.driver(sharp(algorithm, options, wrap))
    driver.save(tmp_path / "ppo")
    again = ganlane.sb3.driver(algorithm.load(tmp_path / "ppo"), "again", stored=tmp_path / "ppo")
    assert again.name == "again"
    others = [again]
    if algorithm is not SAC:
        # By its weights alone, as `ganlane benchmark ppo.zip` loads it.
        others.append(ganlane.load_agent(tmp_path / "ppo.zip"))
    returns = returns_in_the_evaluation(driver)
    for other in others:
        for name in ("observation", "mask", "actions"):
            assert getattr(other, name) == getattr(driver, name)
        assert returns_in_the_evaluation(other) == returns
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
    driver = ganlane.sb3.driver(untrained(PPO, short_episodes(observation="table3")))
    with user_error(r"PPO: it reads observations of shape \[\d+\], but"):
        ganlane.api.evaluate([driver], ["idm"], 2, vehicles=5, **SHORT)
    masked = ganlane.sb3.driver(untrained(sb3_contrib.MaskablePPO, short_episodes()))
    with user_error("no action_mask"):
        ganlane.make_env("idm").rollout(2, masked.policy)


@pytest.mark.parametrize("actions", ["lane", "lane_speed", "continuous"])
@pytest.mark.parametrize("scene", ["highway", "merge"])
@pytest.mark.filterwarnings("error")
def test_the_checker_of_stable_baselines3_warns_of_no_form_of_actions(actions, scene):
    env = gymnasium.make("ganlane/Highway-v0", env=scene, actions=actions)
    check_env(env.unwrapped, skip_render_check=True)
