"""Agents trained again with one thing changed.

Each option is one there is, trainings are compared seed for seed.
"""

from __future__ import annotations

import json

import pytest

from benchmarks import ablations
from ganlane.agents import Rainbow, RainbowConfig, save_agent
from ganlane.config.command_line import check
from ganlane.transforms import observation_size

FEW = ["traffics=[idm]", "fewer={}", "episodes=3", "env.goal_m=60"]


@pytest.fixture
def trained(monkeypatch):
    """Untrained agents in place of trained ones; which were asked for."""
    asked = []

    def save(folder, name, seed, options):
        asked.append((name, seed, tuple(options)))
        agent = Rainbow(
            RainbowConfig(hidden=(8,), batch_size=8, warmup=8, capacity=100),
            observation_size("lane_view", 9),
        )
        training = {"seed": seed, "phase": "train", "traffic": {}, "init": None}
        seen = {
            "observation": "lane_view",
            "observation_scale": {"range_m": 200.0, "speed_mps": 30.0},
        }
        save_agent(folder / "agent.safetensors", agent, {**seen, "training": training})

    monkeypatch.setattr(ablations, "train", save)
    return asked


@pytest.mark.parametrize("name", ablations.ABLATIONS)
def test_what_is_changed_differs_from_the_base_in_that_alone(name):
    base = check("train", ["experiment=ablation"]).composed
    changed = check("train", ["experiment=ablation", *ablations.ABLATIONS[name]]).composed
    assert (base == changed) == (name == ablations.BASE)
    same = {"total_decisions", "evaluate_every", "seed", "init", "env"}
    assert {key for key in base if base[key] != changed[key]} <= {*base} - same


def test_every_training_is_done_once_and_compared_with_the_one_without_a_change(
    trained, tmp_path, capsys
):
    line = [
        f"--runs={tmp_path}/runs",
        f"--out={tmp_path}/out",
        "--only",
        "nothing",
        "safe",
        "--seeds",
        "0",
        "3",
    ]
    for _ in range(2):
        assert (
            ablations.main([*line, "--train", "threads=1", "--", *FEW, f"cells={tmp_path}/cells"])
            == 0
        )
    assert trained == [
        (name, seed, ("threads=1",)) for seed in (0, 3) for name in ("nothing", "safe")
    ]
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert [(row["driver"], row["trainings"], row["episodes"]) for row in results["rows"]] == [
        ("mobil", 1, 3),
        ("nothing", 2, 3),
        ("safe", 2, 3),
    ]
    (compared,) = results["comparisons"]
    means = {row["driver"]: row["mean_reward"] for row in results["rows"]}
    assert (compared["driver"], compared["over"]) == ("safe", "nothing")
    assert compared["lead"] == pytest.approx(means["safe"] - means["nothing"])
    assert results["changed"] == {"nothing": [], "safe": ["mask=safe"]}
    assert results["seeds"]["trainings"] == [0, 3]


def test_a_name_that_there_is_not_is_refused_before_anything_is_trained(trained, tmp_path, capsys):
    assert ablations.main(["--only", "noisy", "--runs", str(tmp_path)]) == 2
    assert "--only noisy: no such ablation; there are nothing, " in capsys.readouterr().err
    assert trained == []


def test_a_training_that_fails_is_named_with_its_log(tmp_path, monkeypatch):
    monkeypatch.setitem(ablations.ABLATIONS, "typo", ("agent.noizy=false",))
    with pytest.raises(
        ablations.UserError, match=r"typo, seed 0: the training ended with 2; see .*log.txt"
    ):
        ablations.train(tmp_path / "run", "typo", 0, [])
    assert "agent.noizy: no such key" in (tmp_path / "run" / "log.txt").read_text()
