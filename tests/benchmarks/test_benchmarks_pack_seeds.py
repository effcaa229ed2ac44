"""Several trainings of one recipe in one file: packed, named, driven and refused."""

from pathlib import Path

import pytest
import torch
from reference.refusals import user_error

from benchmarks import pack_seeds
from ganlane.agents import (
    Rainbow,
    RainbowConfig,
    agent_file,
    checkpoint,
    load_agent,
    read_agent,
    save_agent,
)
from ganlane.agents.checkpoint import SHIPPED, with_seeds
from ganlane.transforms import observation_size

RECIPE = {
    "observation": "lane_view_overlap",
    "observation_scale": {"range_m": 200.0, "speed_mps": 30.0},
    "mask": {"form": "none"},
    "env": {"lanes": 3, "compile": False},
}


def run(folder, seed, hidden=(8, 8), **more):
    """The folder of a finished training with ``seed``."""
    size = observation_size("lane_view_overlap", 9)
    config = RainbowConfig(hidden=hidden, batch_size=8, warmup=8, capacity=100)
    start = str(Path.home() / "outputs/paper_1/pretrain/agent.safetensors")
    metadata = {
        **RECIPE,
        "training": {"seed": seed, "phase": "train", "traffic": {}, "init": start},
        **more,
    }
    save_agent(folder / "agent.safetensors", Rainbow(config, size, seed=seed), metadata)
    return folder


@pytest.fixture
def packed(tmp_path, monkeypatch):
    """A folder of shipped agents: agent_idm with seed 2, and its seeds 0 and 1 in one file."""
    folders = [run(tmp_path / str(seed), seed) for seed in (1, 0)]
    shipped = tmp_path / "checkpoints"
    run(shipped, SHIPPED["agent_idm"])
    (shipped / "agent.safetensors").rename(shipped / "agent_idm.safetensors")
    out = shipped / "seeds_of_agent_idm.safetensors"
    assert pack_seeds.main([*map(str, folders), "--out", str(out)]) == 0
    monkeypatch.setattr(checkpoint, "CHECKPOINTS", shipped)
    return out


@pytest.mark.parametrize("seed", [0, 1])
def test_what_a_greedy_agent_computes_with_is_kept_to_the_last_bit(seed, packed, tmp_path):
    weights, _, metadata = read_agent(f"agent_idm@{seed}")
    alone = read_agent(tmp_path / str(seed) / "agent.safetensors")[0]
    assert weights.keys() == alone.keys()
    for name, value in weights.items():
        assert value.dtype == torch.float32
        if name.endswith("_sigma"):
            torch.testing.assert_close(value, alone[name], rtol=1e-3, atol=1e-6)
        else:
            assert torch.equal(value, alone[name])
    assert metadata["training"]["seed"] == seed
    assert metadata["training"]["init"] == "paper_1/pretrain/agent.safetensors"


def test_names_of_seeds_stand_for_their_agents(packed):
    assert with_seeds("agent_idm@all") == ["agent_idm@0", "agent_idm@1", "agent_idm@2"]
    assert with_seeds("agent_idm@all+safe")[1] == "agent_idm@1+safe"
    with user_error("only the training agent_gan@2 is installed"):
        with_seeds("agent_gan@all")
    assert with_seeds(f"{packed}@all") == [f"{packed}@0", f"{packed}@1"]
    assert with_seeds("mobil") == ["mobil"]
    assert (
        agent_file("agent_idm@2") == agent_file("agent_idm") != agent_file("agent_idm@1") == packed
    )


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("agent_gan@1", "agent_gan@1: no such training"),
        ("1/agent.safetensors@1", "of kind agents, found agent;"),
        ("checkpoints/seeds_of_agent_idm.safetensors", "of kind agent, found agents;"),
    ],
)
def test_a_seed_that_is_not_there_or_not_named_ends_in_a_sentence(
    name, said, packed, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with user_error(said):
        load_agent(name)


@pytest.mark.parametrize(
    ("told", "more"),
    [
        ("another recipe than", {"hidden": (16, 8)}),
        (r"\(env\)", {"env": {"lanes": 4}}),
        ("another run has seed 1", {"seed": 1}),
        ("name no seed", {"training": {}}),
        ("no such file", None),
    ],
)
def test_only_runs_of_one_recipe_and_different_seeds_are_packed(told, more, tmp_path):
    one = run(tmp_path / "one", 1)
    other = tmp_path / "other"
    other.mkdir()
    if more is not None:
        run(other, **{"seed": 2, **more})
    with user_error(told):
        pack_seeds.collect([one, other])


def test_how_an_environment_was_computed_is_no_part_of_the_recipe_but_too_large_a_file_is_refused(
    tmp_path, monkeypatch, capsys
):
    folders = [run(tmp_path / "a", 1), run(tmp_path / "b", 2, env={"lanes": 3, "compile": True})]
    line = [*map(str, folders), "--out", str(tmp_path / "out.safetensors")]
    assert pack_seeds.main(line) == 0
    monkeypatch.setattr(pack_seeds, "MOST_BYTES", 1000)
    assert pack_seeds.main(line) == 2
    assert "give fewer runs" in capsys.readouterr().err
