"""Wrong arguments, actions, seeds and states end in one sentence; autocast changes no episode."""

import gymnasium
import pytest
import torch
from reference.refusals import user_error
from reference.worlds import few_changes, run, same_bits
from tensordict import TensorDict

import ganlane
import ganlane.gym
from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.traffic import IdmTraffic

KERNELS = ["torch", pytest.param("native", marks=pytest.mark.kernel)]


def idm_highways(**options):
    return HighwayEnv(IdmTraffic(), **options)


#: Values that an environment's arguments do not take.
IMPOSSIBLE = {
    "vehicles": (0, -1, 2.5, "nine", 10**9),
    "num_envs": (0, -1, 1.5, None, True, 2**40),
    "dtype": (torch.float16, torch.bfloat16, torch.int64, "float32"),
    "seed": (2**63, -1, 0.5, "one"),
    "first_episode": (2**63, -1, 0.5),
    "device": ("meta", "nonsense"),
    "scenes": (3,),
}


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_an_environment_that_cannot_be_is_refused(name):
    for value in IMPOSSIBLE[name]:
        with user_error(name):
            idm_highways(**{name: value})


@pytest.mark.parametrize("make", [idm_highways, ganlane.make_env])
def test_an_environment_moves_to_no_device_without_numbers(make):
    with user_error("device=meta"):
        make().to("meta")


def test_a_name_is_no_traffic():
    with user_error("expected a TrafficModule"):
        HighwayEnv("idm")


@pytest.mark.parametrize("seed", [-1, "one"])
def test_a_seed_that_is_none_is_refused_where_it_is_set(seed):
    with user_error("seed="):
        idm_highways().set_seed(seed)


def test_the_largest_seed_drives():
    env = idm_highways()
    env.set_seed(2**63 - 1)
    assert env.rollout(2)[keys.SEED].eq(2**63 - 1).all()


NUMBER = r"^action -?\d+: expected 2 whole numbers"
FORM = r"^action of shape"


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize(
    ("action", "told"),
    [
        (torch.tensor([1, 3]), NUMBER),
        (torch.tensor([-1, 1]), NUMBER),
        (torch.tensor([2**62, 0]), NUMBER),
        (torch.tensor([-(2**63), 0]), NUMBER),
        (torch.ones(2), FORM),
        (torch.ones(2, 1).long(), FORM),
        (torch.ones(2).bool(), FORM),
    ],
    ids=str,
)
def test_an_action_that_is_none_is_refused(action, told, kernel):
    env = idm_highways(num_envs=2, kernel=kernel)
    with user_error(told):
        env.step(env.reset().set(keys.ACTION, action))


@pytest.mark.parametrize("kernel", KERNELS)
def test_actions_of_a_shorter_integer_type_are_taken(kernel):
    env = idm_highways(num_envs=2, kernel=kernel)
    short, whole = (
        env.step(env.reset().set(keys.ACTION, torch.tensor([1, 2], dtype=dtype)))["next"]
        for dtype in (torch.int8, torch.int64)
    )
    assert same_bits(short, whole) == []


@pytest.mark.parametrize(
    "state", [{}, {keys.ACTION: torch.ones(1, dtype=torch.int64)}], ids=["nothing", "action"]
)
def test_a_step_before_a_reset_is_refused(state):
    for env in (idm_highways(), ganlane.make_env("idm").base_env):
        with user_error("call reset"):
            env.step(TensorDict(state, [1]))


@pytest.mark.parametrize(
    "counters", [{keys.EPISODE: torch.zeros(2)}, {keys.EPISODE: torch.zeros(2).long()}]
)
def test_a_reset_to_episodes_that_are_none_is_refused(counters):
    with user_error("reset"):
        idm_highways(num_envs=2).reset(TensorDict(counters, [2]))


def test_a_default_device_without_numbers_is_refused_everywhere():
    traffic = IdmTraffic()
    calls = (
        lambda: HighwayEnv(traffic),
        lambda: ganlane.make_env("gan"),
        lambda: ganlane.make_env(env="cut_in"),
        lambda: ganlane.load_agent(),
        lambda: gymnasium.make(ganlane.gym.ENV_ID),
    )
    torch.set_default_device("meta")
    try:
        for call in calls:
            with user_error("default device is meta"):
                call()
    finally:
        torch.set_default_device(None)


@pytest.mark.parametrize(
    "traffic", ["gan_calibrated", "mixed", {"name": "gan", "blind_share": 0.5}], ids=str
)
def test_autocast_changes_no_traffic(traffic):
    env = ganlane.make_env(traffic, 2, kernel="torch").base_env
    *_, plain = run(env, 2, few_changes)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert same_bits(run(env, 2, few_changes)[-1], plain) == []
