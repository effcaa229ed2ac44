"""Trained agents as files, and agents that start from them."""

import pytest
import torch
from agents_small import agent, saved_in
from reference.refusals import user_error
from tensordict import TensorDict

from ganlane.agents import (
    RainbowConfig,
    agent_file,
    checkpoint,
    load_agent,
    read_agent,
    save_agent,
    warm_start,
)
from ganlane.agents.checkpoint import SHIPPED
from ganlane.weights import load_weights, save_weights


@pytest.fixture
def saved(tmp_path):
    return saved_in(tmp_path)


def start_from(learner, path):
    weights, network, _ = read_agent(path)
    warm_start(learner, path, weights, network)


# --- files


def test_a_loaded_agent_drives_like_the_saved_one(saved):
    policy, metadata = load_agent(saved)
    data = TensorDict({"observation": torch.randn(100, 5)}, [100])
    assert torch.equal(policy(data.clone())["action"], agent().greedy(data)["action"])
    assert metadata["observation"] == "table3"
    assert metadata["training"] == {"decisions": 7}
    assert metadata["network"]["v_max"] == RainbowConfig().v_max
    assert metadata["network"]["observation_size"] == 5


def test_another_observation_size_is_refused_naming_both(saved):
    with user_error(r"\[5\].*\[9\]"):
        start_from(agent(size=9), saved)


def test_an_unknown_agent_is_refused_with_the_names_there_are():
    with user_error("agents that ship are agent_gan, agent_general, agent_idm"):
        load_agent("agent_xyz")


def test_shipped_agents_are_found_by_name(saved, monkeypatch):
    monkeypatch.setattr(checkpoint, "CHECKPOINTS", saved.parent)
    saved.rename(saved.with_name("agent_idm.safetensors"))
    assert agent_file("agent_idm") == agent_file(f"agent_idm@{SHIPPED['agent_idm']}")
    assert load_agent("agent_idm")[1]["observation"] == "table3"


#: What a file may say of a network that is none.
DAMAGES = [
    {"wheels": 4},
    {"noisy": "yes"},
    {"hidden": 8},
    {"hidden": ["many"]},
    {"hidden": [-1]},
    {"hidden": [8, 10**9]},
    {"observation_size": None},
    {"actions": 0},
    {"v_min": 200.0},
    {"atoms": True},
    {"atoms": -5},
    {"atoms": 10**12},
]


@pytest.mark.parametrize("damage", DAMAGES, ids=str)
def test_a_network_that_is_not_understood_is_refused(damage, saved):
    tensors, metadata = load_weights(saved, "agent")
    metadata["network"] |= damage
    save_weights(saved, metadata.pop("kind"), tensors, metadata)
    with user_error("its description of the network is not understood"):
        read_agent(saved)


# --- starting from one


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"v_min": -10.0}, r"here: agent.v_min=-10\); set agent.v_min=-120,"),
        (
            {"hidden": (8,), "atoms": 51},
            r"atoms=51\); set agent.hidden=\[8,8\] agent.atoms=101, or start",
        ),
    ],
)
def test_another_network_or_support_is_refused_naming_the_ways_out(options, message, saved):
    with user_error(message):
        start_from(agent(**options), saved)


def test_without_a_distribution_the_support_means_nothing(tmp_path):
    path = tmp_path / "agent.safetensors"
    plain = {"distributional": False}
    save_agent(path, agent(**plain), {})
    start_from(agent(seed=1, v_min=-10.0, atoms=51, **plain), path)


@pytest.mark.parametrize(
    ("kind", "described"),
    [("something else", False), ("agent", False), ("agent", True)],
    ids=["another kind", "no description", "other weights"],
)
def test_weights_that_are_no_agents_are_refused(kind, described, saved):
    _, metadata = load_weights(saved, "agent")
    del metadata["kind"]
    save_weights(saved, kind, {"weight": torch.zeros(3)}, metadata if described else {})
    with user_error(saved.name):
        load_agent(saved)
