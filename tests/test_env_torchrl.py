"""The environment inside TorchRL's loops, and in programs with torch's other settings."""

import multiprocessing
from functools import partial

import pytest
import torch
from reference.refusals import user_error
from reference.worlds import same_bits, step
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import ExcludeTransform, ParallelEnv, RemoveEmptySpecs, SerialEnv
from torchrl.envs.utils import check_env_specs

import ganlane
from ganlane import keys
from ganlane.env.state import checked_action
from ganlane.settings.actions import ActionParameters

TRAFFICS = ("idm_random", "idm_faults", "gan_calibrated", "mixed")
KEEP = torch.zeros(2, dtype=torch.int64)


def decided(env, **state):
    """The state after a first decision to keep the lane."""
    return step(env, env.reset().update(state))


# Several environments in one


@pytest.mark.parametrize("traffic", ["gan", "mixed"])
def test_a_traffic_with_parts_that_remember_nothing_runs_in_a_serial_environment(traffic):
    make = partial(ganlane.make_env, traffic, 2, decision_period_s=0.1)
    assert SerialEnv(2, make).rollout(1).batch_size == (2, 2, 1)


def test_workers_of_a_seeded_serial_environment_drive_different_episodes():
    env = SerialEnv(2, partial(ganlane.make_env, "idm", 2, kernel="torch"))
    env.set_seed(3)
    first, second = env.reset()
    assert first[keys.SEED].tolist() == [3, 3]
    assert not torch.equal(first[keys.VEHICLES, "x"], second[keys.VEHICLES, "x"])


def test_an_unseeded_worker_process_has_a_seed_of_its_own(monkeypatch):
    make = partial(ganlane.make_env, kernel="torch")
    assert make().reset()[keys.SEED].tolist() == [0]
    worker = multiprocessing.Process(target=check_env_specs)
    worker._identity = (2, 3)
    monkeypatch.setattr(multiprocessing, "current_process", lambda: worker)
    assert make().reset()[keys.SEED].tolist() == [2003]
    assert make(seed=0).reset()[keys.SEED].tolist() == [0]


@pytest.mark.slow  # starts four processes
def test_unseeded_workers_of_torchrl_drive_different_episodes():
    make = partial(ganlane.make_env, "idm", 2)
    env = ParallelEnv(2, make)
    assert env.reset()[keys.SEED][:, 0].unique().numel() == 2
    env.close()
    collector = MultiSyncCollector([make] * 2, frames_per_batch=8, total_frames=8)
    (batch,) = collector
    assert batch[keys.SEED].unique().numel() == 2
    collector.shutdown()


def test_the_terms_of_the_reward_can_be_left_out():
    terms = [(keys.REWARD_TERMS, name) for name in keys.REWARD_TERM_NAMES]
    env = ganlane.make_env("idm", 2, transforms=[ExcludeTransform(*terms), RemoveEmptySpecs()])
    check_env_specs(env)
    assert keys.REWARD_TERMS not in env.rollout(2)["next"]


# Torch's settings


@pytest.mark.parametrize("traffic", TRAFFICS)
def test_episodes_are_the_same_bits_whatever_torchs_default_type_is(traffic):
    make = partial(ganlane.make_env, traffic, 2, mask="safe", decision_period_s=0.3, kernel="torch")
    single = decided(make())
    torch.set_default_dtype(torch.float64)
    try:
        assert same_bits(decided(make()), single) == []
    finally:
        torch.set_default_dtype(torch.float32)


def test_the_check_of_actions_is_part_of_a_compiled_graph():
    check = torch.compile(checked_action, fullgraph=True, backend="eager")
    assert torch.equal(check(KEEP, 2, ActionParameters()), KEEP)
    with pytest.raises(RuntimeError, match="action: each must be 0 to 2"):
        check(KEEP - 1, 2, ActionParameters())


@pytest.mark.slow  # tracing takes some seconds
def test_a_step_compiles_to_one_graph():
    env = ganlane.make_env("idm_mobil", 2, decision_period_s=0.1, kernel="torch")
    state = env.reset().set(keys.ACTION, KEEP)
    plain = env.step(state.clone())
    step = torch.compile(env.step, fullgraph=True, backend="eager")
    assert same_bits(step(state)["next"], plain["next"]) == []


def decided_with_gradients(kernel):
    """Speeds whose gradients are asked for, and the state after a decision from them."""
    env = ganlane.make_env("idm_mobil", 2, kernel=kernel)
    speed = env.reset()[keys.VEHICLES, "speed"].requires_grad_()
    return speed, decided(env, vehicles={"speed": speed})


@pytest.mark.parametrize("kernel", ["torch", "auto"])
def test_gradients_pass_through_a_decision(kernel):
    speed, after = decided_with_gradients(kernel)
    for name in (keys.REWARD, keys.OBSERVATION):
        (gradient,) = torch.autograd.grad(after[name].sum(), speed, retain_graph=True)
        assert (gradient[:, 0] != 0).all()


def test_the_kernel_alone_refuses_gradients():
    with user_error(r"under torch\.no_grad"):
        decided_with_gradients("native")
    with torch.no_grad():
        decided_with_gradients("native")
