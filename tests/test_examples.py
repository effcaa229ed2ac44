"""Every example runs and prints its result, and the one shown in the docs is the one that runs."""

import importlib.util
import re
import runpy
import sys

import pytest
import torch
from reference.processes import ROOT

#: What a run must print, so that an example that does nothing fails.
EXAMPLES = {
    "own_traffic.py": r"mean speed of the others \d+\.\d m/s, \d+ % look away",
    "own_reward.py": r"random_legal courteous: mean return +-?\d+\.\d, \d+ onsets behind",
    "own_function.py": r"(?s)entry .*drive .*shift-v1, quick, protocol ",
    "own_policy.py": r"(?s)mobil .*agent_idm .*random_legal .*largest_gap ",
    "torchrl_dqn.py": r"(?s)loss \d+\.\d+, reward per decision -?\d+\.\d+.*torchrl_dqn .*mobil ",
    "torchrl_ppo.py": r"(?s)reward per decision -?\d+\.\d+.*torchrl_ppo .*mobil ",
    "cleanrl_style.py": (
        r"2048 decisions, \d+ episodes, loss \d+\.\d+\nmean return of the last \d+: -?\d+\.\d"
    ),
    "sb3_ppo.py": r"(?s)ppo .*mobil ",
    "sb3_exit.py": r"(?s)maskableppo .*mobil ",
    "sb3_human.py": r"(?s)maskableppo .*mobil_egoistic ",
    "sb3_sac_merge.py": r"(?s)sac .*mobil ",
    "sb3_dqn.py": (
        r"(?s)300 decisions, mean return of the last \d+ episodes -?\d+\.\d.*sb3_dqn.*mobil"
        ".*random_legal"
    ),
}
#: Budgets that keep a run to seconds.
SHORT = {
    "own_function.py": ["30"],
    "own_reward.py": ["20"],
    "own_traffic.py": ["3"],
    "torchrl_dqn.py": ["1024", "2", "60", "16"],
    "torchrl_ppo.py": ["1024", "2", "60", "16"],
    "cleanrl_style.py": ["2048"],
    "sb3_dqn.py": ["300", "4", "200"],
    "sb3_ppo.py": ["4096", "safe", "MaskablePPO", "4", "200", "16"],
    "sb3_exit.py": ["1024", "1024", "4", "16"],
    "sb3_human.py": ["1024", "1024", "2", "5"],
    "sb3_sac_merge.py": ["64", "SAC", "2", "4"],
}
#: What an example needs beside ganlane.
NEEDS = {
    "sb3_dqn.py": "stable_baselines3",
    "sb3_ppo.py": "sb3_contrib",
    "sb3_exit.py": "sb3_contrib",
    "sb3_human.py": "sb3_contrib",
    "sb3_sac_merge.py": "stable_baselines3",
}


def test_every_example_is_run_here():
    assert {path.name for path in (ROOT / "examples").glob("*.py")} == set(EXAMPLES)


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_example_runs_and_prints_its_result(name, monkeypatch, capsys, empty_folder):
    if name in NEEDS and importlib.util.find_spec(NEEDS[name]) is None:
        pytest.skip(f"{NEEDS[name]} is not installed")
    monkeypatch.setattr(sys, "argv", [name, *SHORT.get(name, [])])
    # Of a suite two episodes on each traffic; whether recordings are at hand has no effect.
    monkeypatch.setattr("ganlane.settings.suite.QUICK_SHARE", 0.0)
    monkeypatch.setenv("GANLANE_DATA", str(empty_folder))
    with torch.random.fork_rng():
        runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")
    assert re.search(EXAMPLES[name], capsys.readouterr().out)


def test_the_traffic_model_in_the_docs_is_the_one_that_runs():
    shown = re.search(
        r"```python\n(class Daydreamers.*?)```", (ROOT / "docs" / "traffic.md").read_text(), re.S
    )
    assert shown.group(1).strip() in (ROOT / "examples" / "own_traffic.py").read_text()


@pytest.mark.parametrize(
    ("pattern", "folder"),
    [
        (r"\]\((?!https:)([^)#]+)", ROOT / "docs"),  # links between the pages
        (r"`((?:ganlane|tests|examples|conf)/[\w/]+\.(?:py|yaml))`", ROOT),
    ],
)
def test_the_docs_name_only_files_that_exist(pattern, folder):
    pages = (ROOT / "docs").glob("*.md")
    names = {(page.name, name) for page in pages for name in re.findall(pattern, page.read_text())}
    assert names
    assert sorted((page, name) for page, name in names if not (folder / name).exists()) == []
