"""Trained agents as files."""

import pytest
import torch
from agents_small import agent, saved_in
from tensordict import TensorDict

from ganlane.agents import RainbowConfig, agent_file, checkpoint, load_agent, transfer
from ganlane.errors import UserError


@pytest.fixture
def saved(tmp_path):
    return saved_in(tmp_path)


def test_a_loaded_agent_drives_like_the_saved_one(saved):
    policy, metadata = load_agent(saved, observation_size=5)
    data = TensorDict({"observation": torch.randn(100, 5)}, [100])
    assert torch.equal(policy(data.clone())["action"], agent().greedy(data.clone())["action"])
    assert metadata["observation"] == "table3"
    assert metadata["training"] == {"decisions": 7}
    assert metadata["network"]["v_max"] == RainbowConfig().v_max
    assert metadata["network"]["observation_size"] == 5


def test_another_observation_size_is_refused_naming_both(saved):
    with pytest.raises(UserError, match=r"\[5\].*\[9\]"):
        load_agent(saved, observation_size=9)
    with pytest.raises(UserError, match=r"\[5\].*\[9\]"):
        transfer(agent(size=9), saved)


def test_a_truncated_or_foreign_file_is_refused(saved, tmp_path):
    whole = saved.read_bytes()
    saved.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match="checkpoint of kind agent"):
        load_agent(saved)
    other = tmp_path / "notes.txt"
    other.write_text("hello")
    with pytest.raises(UserError, match="checkpoint of kind agent"):
        load_agent(other)


def test_an_unknown_agent_is_refused_with_the_names_there_are():
    with pytest.raises(UserError, match="agents that ship are agent_gan, agent_general, agent_idm"):
        load_agent("agent_xyz")


def test_shipped_agents_are_found_by_name(saved, monkeypatch):
    monkeypatch.setattr(checkpoint, "CHECKPOINTS", saved.parent)
    saved.rename(saved.with_name("agent_idm.safetensors"))
    assert agent_file("agent_idm") == agent_file("agent_idm@0")
    assert load_agent("agent_idm")[1]["observation"] == "table3"
