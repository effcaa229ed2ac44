"""The highway through gymnasium: one environment, a batch, and what gymnasium expects of them."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode
from reference.gym_env import ID, KEEP, LEFT, RIGHT, make, make_vec, until_the_end
from reference.processes import run
from reference.refusals import user_error

from ganlane.gym import ENV_IDS
from ganlane.gym.rows import row_of


@pytest.mark.parametrize("name", sorted(ENV_IDS.keys() - {ID}))
def test_every_id_is_one_highway_and_a_batch(name):
    env = gymnasium.make(name)
    envs = gymnasium.make_vec(name, num_envs=2)
    assert env.spec.kwargs == ENV_IDS[name]
    np.testing.assert_array_equal(env.reset(seed=3)[0], envs.reset(seed=3)[0][0])


def decisions_until_cut_off(env):
    env.reset(seed=0)
    *_, terminated, truncated, info = until_the_end(env)
    assert truncated > terminated
    return info["decisions"]


@pytest.mark.parametrize(("timeout_s", "period_s", "decisions"), [(7.0, 0.5, 14), (7.2, 2.0, 4)])
def test_the_spec_says_when_an_episode_is_cut_off_and_nothing_else_cuts_it(
    timeout_s, period_s, decisions
):
    options = {"goal_m": 5000.0, "timeout_s": timeout_s, "decision_period_s": period_s}
    env, envs = make(**options), make_vec(2, **options)
    again, envs_again = gymnasium.make(env.spec), gymnasium.make_vec(envs.spec)
    cut_off_after = {one.spec.max_episode_steps for one in (env, envs, again, envs_again)}
    assert cut_off_after == {decisions_until_cut_off(one) for one in (env, again)} == {decisions}
    assert gymnasium.make(ID).spec.max_episode_steps == 1000


def test_a_shorter_time_limit_is_gymnasiums_own_and_refused_for_a_batch():
    env = gymnasium.make(ID, max_episode_steps=5)
    assert env.spec.max_episode_steps == decisions_until_cut_off(env) == 5
    with user_error(r"max_episode_steps=5: .* give timeout_s=5\."):
        gymnasium.make_vec(ID, num_envs=2, max_episode_steps=5)


@pytest.mark.parametrize(
    "options",
    [
        {"traffic": "gan"},
        {"lanes": 4, "vehicles": 15, "recycle": True, "observation": "table3"},
        {"env": "cut_in", "observation": "table3_lane_view", "render_mode": "rgb_array"},
        {"env": "merge", "actions": "lane_speed", "render_mode": "rgb_array"},
        {"env": "exit", "actions": "continuous", "render_mode": "rgb_array"},
        *(
            {"env": env, "observation": "road_view", "mask": "safe"}
            for env in ("merge", "on_ramp", "lane_drop", "weave", "exit")
        ),
    ],
    ids=str,
)
@pytest.mark.filterwarnings("error")
def test_gymnasiums_own_check_finds_nothing_to_say(options):
    check_env(make(**options).unwrapped)
    envs = make_vec(3, **options)
    assert envs.observation_space.contains(envs.reset(seed=1)[0])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("traffic", "mode"),
    [("gan", AutoresetMode.SAME_STEP), *(("idm", mode) for mode in AutoresetMode)],
)
def test_neither_making_nor_running_a_batch_warns(traffic, mode):
    """gymnasium has no checker for batches: this is what its one for one environment looks at."""
    envs = gymnasium.make_vec(ID, num_envs=3, traffic=traffic, goal_m=60.0, autoreset_mode=mode)
    first, info = envs.reset(seed=0)
    assert data_equivalence(envs.reset(seed=0), (first, info), exact=True)
    for _ in range(6):
        observation, reward, terminated, truncated, info = envs.step(envs.action_space.sample())
        assert envs.observation_space.contains(observation)
        before = copy.deepcopy((observation, reward, info))
        ended = terminated | truncated
        if mode is AutoresetMode.DISABLED and ended.any():
            envs.reset(options={"reset_mask": ended})
        else:
            envs.step(np.zeros(3, int))
            envs.reset()
        assert data_equivalence(before, (observation, reward, info), exact=True)
    envs.close()
    envs.close()
    assert envs.metadata["autoreset_mode"] is mode
    assert reward.shape == terminated.shape == truncated.shape == (3,)
    assert terminated.dtype == truncated.dtype == np.bool_


@pytest.mark.kernel
def test_the_id_imports_the_package_which_drives_by_rules_without_torch_and_hydra():
    code = (
        "import sys, gymnasium; env = gymnasium.make('ganlane:ganlane/Highway-v0'); "
        "env.reset(seed=0); env.step(0); "
        "print({'torch', 'hydra', 'polars', 'PIL'} & sys.modules.keys())"
    )
    assert run("-c", code).stdout == "set()\n"


def test_episodes_follow_from_seed_and_number():
    env = make()
    first, _ = env.reset(seed=5)
    second, info = env.reset()
    assert not np.array_equal(first, second)
    for observation, same in (
        (second, info),
        env.reset(options={"episode": 1}),
        make(seed=5).reset(options={"episode": 1}),
    ):
        assert (same["seed"], same["episode_number"]) == (5, 1)
        np.testing.assert_array_equal(observation, second)


def test_without_a_seed_two_environments_differ():
    assert len({make().reset()[1]["seed"] for _ in range(3)}) == 3


@pytest.mark.kernel
@pytest.mark.parametrize("actions", ["lane", "lane_speed", "continuous"])
def test_one_highway_tells_what_the_first_row_of_a_batch_does(actions):
    """It reads its info from the kernel's arrays in a shorter way."""
    env = make(actions=actions, lane_width_m=3.7)
    env.reset(seed=3)
    rows = env.unwrapped._rows
    for _ in range(20):
        *_, terminated, truncated, info = env.step(env.action_space.sample() * 0)
        assert data_equivalence(info, row_of(rows.info(), 0))
        assert list(info) == list(row_of(rows.info(), 0))
        if terminated or truncated:
            env.reset()


@pytest.mark.kernel
def test_pictures_change_nobody():
    """With a render mode the same kernel drives, behind the TorchRL environment."""
    drawn = make(render_mode="rgb_array")
    assert drawn.unwrapped._rows.env.base_env.kernel is not None
    plain, drawn = (
        [env.reset(seed=1)[0], *map(env.step, (LEFT, KEEP, RIGHT))] for env in (make(), drawn)
    )
    assert data_equivalence(plain, drawn, exact=True)


def test_leaving_the_road_terminates_and_the_mask_says_so_beforehand():
    env = make(lanes=1)
    _, info = env.reset(seed=0)
    np.testing.assert_array_equal(info["action_mask"], [1, 0, 0])
    _, reward, terminated, _, info = env.step(LEFT)
    assert terminated
    assert info["out_of_road"]
    assert reward == pytest.approx(sum(info["reward_terms"].values()), rel=1e-6)


def returns_by_episode(mode, kernel):
    """Return of every finished episode by its number; all rows keep their lanes."""
    envs = make_vec(3, kernel=kernel, autoreset_mode=mode, goal_m=40.0)
    assert envs.metadata["autoreset_mode"] is mode
    _, info = envs.reset(seed=4)
    running = np.zeros(3)
    numbers = info["episode_number"]
    ended = np.zeros(3, bool)
    returns = {}
    for _ in range(10):
        before = ended
        _, reward, terminated, truncated, info = envs.step(np.zeros(3, int))
        if mode is AutoresetMode.NEXT_STEP:
            assert not reward[before].any()
            assert not info["time_s"][before].any()
        running += reward
        ended = terminated | truncated
        returns |= {int(numbers[row]): running[row] for row in np.flatnonzero(ended)}
        if mode is AutoresetMode.DISABLED and ended.any():
            _, info = envs.reset(options={"reset_mask": ended})
        running[ended], numbers = 0.0, info["episode_number"]
    return returns


@pytest.mark.parametrize("kernel", ["auto", "torch"])
def test_episodes_are_the_same_in_every_autoreset_mode(kernel):
    same = returns_by_episode(AutoresetMode.SAME_STEP, kernel)
    for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED):
        other = returns_by_episode(mode, kernel)
        shared = same.keys() & other.keys()
        assert len(shared) >= 6
        assert {number: other[number] for number in shared} == pytest.approx(
            {n: same[n] for n in shared}, abs=1e-3
        )


def test_a_row_that_is_over_is_not_stepped_where_resets_are_left_to_the_user():
    envs = make_vec(2, lanes=1, autoreset_mode="disabled")
    envs.reset(seed=0)
    envs.step(np.array([LEFT, KEEP]))
    with user_error(r"rows \[0\] are over; call reset"):
        envs.step(np.array([KEEP, KEEP]))
    with user_error("expected one of next_step, same_step, disabled"):
        make_vec(2, autoreset_mode="never")


def test_a_row_that_ends_is_reset_in_the_same_step_and_tells_how_it_ended():
    envs = make_vec(3, lanes=1, goal_m=500.0)
    first, _ = envs.reset(seed=0)
    observation, _, terminated, truncated, info = envs.step(np.array([KEEP, LEFT, KEEP]))
    np.testing.assert_array_equal(terminated | truncated, [False, True, False])
    np.testing.assert_array_equal(info["_final_obs"], [False, True, False])
    assert info["final_obs"][0] is None
    # off the road at once: nothing moved
    np.testing.assert_array_equal(info["final_obs"][1], first[1])
    assert info["final_info"]["out_of_road"][1]
    assert info["final_info"]["episode_number"][1] == 1
    np.testing.assert_array_equal(info["episode_number"], [0, 4, 2])
    np.testing.assert_array_equal(info["time_s"], [1.0, 0.0, 1.0])
    assert not np.array_equal(observation[1], first[1])
    assert not info["out_of_road"].any()


def test_rows_can_be_sent_on_by_hand_and_the_others_stay():
    envs = make_vec(3, goal_m=500.0)
    envs.reset(seed=0)
    before, *_, old = envs.step(np.zeros(3, int))
    after, info = envs.reset(options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal((before == after).all(1), [True, False, True])
    np.testing.assert_array_equal(info["episode_number"], old["episode_number"] + [0, 3, 0])
    _, info = envs.reset()
    np.testing.assert_array_equal(info["episode_number"], [3, 7, 5])
    _, info = envs.reset(seed=[7, 8, 9], options={"episode": np.array([4, 4, 0])})
    np.testing.assert_array_equal(info["seed"], [7, 8, 9])
    np.testing.assert_array_equal(info["episode_number"], [4, 4, 0])


def begun(env):
    env.reset(seed=0)
    return env.unwrapped


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: make(traffic="gann"), "traffic=gann: no such option .did you mean 'gan'.."),
        (lambda: make(lane=4), "env.lane: no such key .did you mean 'lanes'.."),
        (lambda: make(seed=-1), "seed=-1: expected a whole number from 0"),
        (lambda: make(render_mode="ansi"), "render_mode=ansi: expected one of human, rgb_array"),
        (lambda: make_vec(2, render_mode=5), "render_mode=5: a batch has rgb_array only"),
        (lambda: make_vec(True), "num_envs=true: expected a whole number"),
        (lambda: make().unwrapped.step(KEEP), "call reset"),
        (lambda: make_vec(2).step(np.zeros(2, int)), "call reset"),
        (lambda: make(render_mode="rgb_array").unwrapped.render(), "call reset"),
        (lambda: begun(make()).render(), "made without render_mode"),
        (lambda: begun(make_vec(2)).render(), "made without render_mode"),
        (lambda: make().reset(seed=np.array([1, 2])), "seed=array"),
        (lambda: make().reset(options={"episodes": 3}), "episodes unknown; a reset takes episode"),
        (lambda: make().reset(options={"episode": -3}), "expected a whole number from 0"),
        (
            lambda: make_vec(2).reset(options={"episode": [[1, 2], [3]]}),
            "expected whole numbers from 0",
        ),
        (
            lambda: make_vec(2).reset(seed=[1, 2, 3]),
            "expected one seed and one episode, or 2 of each",
        ),
        (
            lambda: make_vec(2).reset(options={"reset_mask": np.array([1, 0])}),
            r"a boolean array of shape \(2,\)",
        ),
        (
            lambda: begun(make_vec(2)).reset(
                seed=3, options={"reset_mask": np.array([True, False])}
            ),
            "leave out seed and episode",
        ),
        (lambda: begun(make()).step(3), r"0 \(keep\), 1 \(left\) or 2 \(right\)"),
        (lambda: begun(make_vec(2)).step(np.zeros(3, int)), "expected 2 whole number"),
        (lambda: begun(make_vec(2)).step([[0, 1], [2]]), r"expected \d whole number"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*render_mode")
def test_a_wrong_argument_is_refused_in_a_sentence(call, message):
    with user_error(message):
        call()


def test_the_safe_mask_is_in_the_info_and_behind_maskable_ppos_method():
    env = make(mask="safe", traffic="idm_mobil", goal_m=5000.0)
    _, info = env.reset(seed=0)
    masks = [info["action_mask"]]
    for _ in range(15):
        mask = env.unwrapped.action_masks()
        assert mask.dtype == np.bool_
        np.testing.assert_array_equal(mask, info["action_mask"].astype(bool))
        *_, info = env.step(KEEP)
        masks.append(info["action_mask"])
    keep, *changes = np.stack(masks).T
    assert keep.all()
    assert not np.all(changes)


@pytest.mark.parametrize(
    ("traffic", "twin"),
    [("idm_mobil", copy.deepcopy), ("gan", lambda env: pickle.loads(pickle.dumps(env)))],
)
def test_a_copy_goes_on_as_the_environment_does_and_leaves_it_alone(traffic, twin):
    env = make(traffic=traffic, mask="safe", goal_m=300.0)
    env.reset(seed=3)
    env.step(LEFT)
    other = twin(env)
    theirs = [other.step(action) for action in (KEEP, RIGHT)]
    ours = [env.step(action) for action in (KEEP, RIGHT)]
    assert data_equivalence(ours, theirs, exact=True)
