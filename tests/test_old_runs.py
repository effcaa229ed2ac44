"""Runs and agents of version 0.1 load, drive and go on.

``fixtures/run_0_1`` was written by that version.
"""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

import ganlane
from ganlane.agents import read_agent
from ganlane.train import main

OLD_RUN = Path(__file__).parent / "fixtures" / "run_0_1"
#: Two vehicles around the ego, and the progress of its lane change: 3 + 3 * 2 + 2 numbers.
OBSERVATION_SIZE = 11


@pytest.fixture
def old_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return shutil.copytree(OLD_RUN, tmp_path / "run")


def test_an_old_agent_drives_the_traffic_that_it_was_trained_for():
    agent = ganlane.load_agent(str(OLD_RUN / "agent.safetensors"), vehicles=3)
    assert agent.observation.form == "table3_progress"
    observations = torch.linspace(-1.0, 1.0, 6 * OBSERVATION_SIZE).reshape(6, OBSERVATION_SIZE)
    actions = agent.policy(TensorDict({"observation": observations}, [6]))["action"]
    assert set(actions.tolist()) <= {0, 1, 2}
    _, config, metadata = read_agent(OLD_RUN / "agent.safetensors")
    assert config.hidden == (8, 8)
    assert metadata["training"]["decisions"] == 320


def test_an_old_run_goes_on_where_it_stopped(old_run):
    assert main([f"resume={old_run}", "total_decisions=480"]) == 0
    rows = list(csv.DictReader((old_run / "metrics.csv").open()))
    assert [int(row["decisions"]) for row in rows] == [160, 320, 480]
    assert json.loads((old_run / "results.json").read_text())["decisions"] == 480
    before, after = (read_agent(folder / "agent.safetensors")[0] for folder in (OLD_RUN, old_run))
    assert before.keys() == after.keys()
    assert any((before[name] != after[name]).any() for name in before)


@pytest.mark.parametrize("name", ["agent_idm", "agent_gan"])
def test_a_shipped_agent_drives_ten_decisions_without_a_crash(name):
    agent = ganlane.load_agent(name)
    env = ganlane.make_env("idm_mobil", 8, observation=agent.observation.form, stream="report")
    rollout = env.rollout(10, agent.policy, break_when_any_done=False)
    assert rollout["action"].shape == (8, 10)
    assert not rollout["next", "events", "hard_crash"].any()
