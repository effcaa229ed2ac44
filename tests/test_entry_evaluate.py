"""``ganlane evaluate`` from end to end, with tiny budgets, in process."""

from __future__ import annotations

import json
from pathlib import Path

import polars as pl
import pytest

from ganlane.evaluate import main

SHORT = ["env.goal_m=40", "episodes=4"]


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # A console script's users keep their own modules where they start it.
    monkeypatch.syspath_prepend(str(Path(__file__).parent))


def run(capsys, *arguments):
    """Exit status, last line of stdout, stderr."""
    status = main([*SHORT, *arguments])
    out, err = capsys.readouterr()
    return status, (out.splitlines() or [""])[-1], err


def test_table_and_files_hold_every_agent_on_every_traffic(capsys):
    status, last, _ = run(capsys, "agents=[mobil,random_legal]", "traffics=[idm,idm_mobil]")
    assert status == 0
    path = Path(last.removeprefix("results: "))
    results = json.loads(path.read_text())
    pairs = [(row["agent"], row["traffic"]) for row in results["rows"]]
    assert pairs == [(agent, traffic) for traffic in ("idm", "idm_mobil") for agent in ("mobil", "random_legal")]
    assert all(row["episodes"] == 4 for row in results["rows"])
    assert results["rows"][0]["normalized_percent"] == pytest.approx(100.0)
    assert {"config", "code", "machine", "seeds"} <= results.keys()
    episodes = pl.read_parquet(path.parent / "episodes.parquet")
    assert episodes.height == 16
    assert (path.parent / "config.yaml").is_file()


def test_the_same_command_gives_the_same_numbers_whatever_the_batch(capsys):
    rewards = []
    for num_envs in (4, 3):
        _, last, _ = run(capsys, "agents=[random_legal]", "traffics=[idm_mobil]", f"num_envs={num_envs}")
        rewards.append(json.loads(Path(last.removeprefix("results: ")).read_text())["rows"][0]["mean_reward"])
    assert rewards[0] == rewards[1]


def test_a_users_traffic_and_policy_stand_in_the_table(capsys):
    own = ["agents=[entry_own_parts.Stubborn,keep_lane]", "traffics=[entry_own_parts.Cruise]"]
    status, last, _ = run(capsys, *own)
    assert status == 0
    rows = json.loads(Path(last.removeprefix("results: ")).read_text())["rows"]
    assert [row["agent"] for row in rows] == ["entry_own_parts.Stubborn", "keep_lane"]
    assert rows[0]["mean_reward"] == rows[1]["mean_reward"]
    assert rows[0]["traffic"] == "entry_own_parts.Cruise"


def test_a_users_traffic_takes_parameters_of_its_own(capsys):
    target = ["traffic_options.idm._target_=entry_own_parts.Cruise", "+traffic_options.idm.parameters.share=0.5"]
    assert run(capsys, "agents=[keep_lane]", "traffics=[idm]", *target)[0] == 0
    wrong = [target[0], "+traffic_options.idm.parameters.pace=0.5"]
    status, _, err = run(capsys, "agents=[keep_lane]", "traffics=[idm]", *wrong)
    assert status == 2
    assert "pace" in err
    assert "it takes road, stream, share" in err


@pytest.mark.usefixtures("hydra_from_memory")
@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["agents=[nobody]"], "agent nobody: unknown; choose one of random, random_legal, keep_lane, mobil"),
        (["agents=[gone.safetensors]"], "agent gone.safetensors: no such file"),
        (["agents=[no.such.Policy]"], "agents=no.such.Policy: 'no.such' cannot be imported"),
        (["agents=[os.path]"], "expected a subclass of tensordict"),
        (["agents=[mobil]", "traffics=[no.such.Traffic]"], "traffic._target_=no.such.Traffic"),
        (["agents=[mobil]", "traffics=[entry_own_parts.Missing]"], "entry_own_parts has no Missing"),
        (["agents=[mobil]", "traffics=[entry_own_parts.Stubborn]"], "expected a subclass of"),
        (["agents=[mobil]", "traffics=[entry_own_parts.not_a_model]"], "expected a subclass of"),
        (
            ["agents=[mobil]", "traffics=[gan]", "generator.path=gone"],
            "gone: no such file; a checkpoint of kind generator",
        ),
    ],
)
def test_a_mistake_leaves_one_sentence_and_no_file(arguments, part, tmp_path, capsys):
    status, last, err = run(capsys, *arguments)
    assert (status, last) == (2, "")
    assert part in err
    assert len([line for line in err.splitlines() if line.startswith("ganlane evaluate: ")]) == 1
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == []
