"""Every example runs and prints its result, and the one shown in the docs is the one that runs."""

import re
import runpy
import sys

import pytest
import torch
from reference.processes import ROOT, python_blocks

#: Command line, with a budget that keeps a run to seconds, and what it must print, so that an
#: example that does nothing fails.
EXAMPLES = {
    "own_traffic.py 3": r"mean speed of the others \d+\.\d m/s, \d+ % look away",
    "own_reward.py 20": r"random_legal courteous: mean return +-?\d+\.\d, \d+ onsets behind",
    "own_function.py 30": r"(?s)entry .*drive .*shift-v1, quick, protocol ",
    "own_policy.py": r"(?s)mobil .*agent_idm .*random_legal .*largest_gap ",
    "torchrl_dqn.py 1024 2 60 16": (
        r"(?s)loss \d+\.\d+, reward per decision -?\d+\.\d+.*torchrl_dqn .*mobil "
    ),
    "torchrl_ppo.py 1024 2 60 16": r"(?s)reward per decision -?\d+\.\d+.*torchrl_ppo .*mobil ",
    "cleanrl_style.py 2048": (
        r"2048 decisions, \d+ episodes, loss \d+\.\d+\nmean return of the last \d+: -?\d+\.\d"
    ),
    "sb3_ppo.py 4096 safe MaskablePPO 4 200 16": r"(?s)ppo .*mobil ",
    "sb3_exit.py 1024 1024 4 16": r"(?s)maskableppo .*mobil ",
    "sb3_human.py 1024 1024 2 5": r"(?s)maskableppo .*mobil_egoistic ",
    "sb3_sac_merge.py 64 SAC 2 4": r"(?s)sac .*mobil ",
    "sb3_dqn.py 300 4 200": (
        r"(?s)300 decisions, mean return of the last \d+ episodes -?\d+\.\d.*sb3_dqn.*mobil"
        ".*random_legal"
    ),
}


def test_every_example_is_run_here():
    names = {path.name for path in (ROOT / "examples").glob("*.py")}
    assert names == {line.split()[0] for line in EXAMPLES}


@pytest.mark.usefixtures("no_recordings")  # whether there are some has no effect
@pytest.mark.parametrize("line", EXAMPLES)
def test_the_example_runs_and_prints_its_result(line, monkeypatch, capsys):
    if line.startswith("sb3_"):
        pytest.importorskip("sb3_contrib", reason="the extra sb3 is not installed")
    monkeypatch.setattr(sys, "argv", line.split())
    # Of a suite two episodes on each traffic.
    monkeypatch.setattr("ganlane.settings.suite.QUICK_SHARE", 0.0)
    with torch.random.fork_rng():
        runpy.run_path(str(ROOT / "examples" / line.split()[0]), run_name="__main__")
    assert re.search(EXAMPLES[line], capsys.readouterr().out)


def test_the_traffic_model_in_the_docs_is_the_one_that_runs():
    (shown,) = (block for block in python_blocks("traffic.md") if "class Daydreamers" in block)
    assert shown.strip() in (ROOT / "examples" / "own_traffic.py").read_text()


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
