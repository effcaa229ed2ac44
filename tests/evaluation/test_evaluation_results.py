"""What stays in the run folder can be read back and says where it came from."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

import ganlane
from ganlane.evaluation import code_version, results, write_results
from ganlane.evaluation.results import Run


@dataclass
class Config:
    agents: tuple[str, ...]
    folder: Path


def test_numbers_and_their_origin_are_kept(tmp_path):
    row = {"mean_reward": np.float32(1.5), "ci": np.array([1.0, 2.0]), "score": float("nan")}
    config = {"evaluate": Config(("mobil",), Path("a/b")), "weight": torch.tensor(2)}
    seeds = {"seed": 3, "episodes": range(3)}
    path = write_results(tmp_path / "run", {"rows": [row]}, config, seeds)
    assert path.name == "results.json"
    read = json.loads(path.read_text())
    assert read["rows"] == [{"mean_reward": 1.5, "ci": [1.0, 2.0], "score": None}]
    assert read["config"] == {
        "evaluate": {"agents": ["mobil"], "folder": str(Path("a/b"))},
        "weight": 2,
    }
    assert read["seeds"] == {"seed": 3, "episodes": [0, 1, 2]}
    assert read["code"]["version"] == ganlane.__version__
    machine = read["machine"]
    assert (machine["torch"], machine["threads"]) == (torch.__version__, torch.get_num_threads())
    assert machine["cores"] >= 1


def test_a_copy_in_somebody_elses_checkout_has_no_revision(monkeypatch, tmp_path):
    monkeypatch.setattr(results, "PACKAGE", tmp_path)
    nothing = {"revision": None, "modified": None}
    assert code_version() == {"version": ganlane.__version__, **nothing}


def test_a_run_is_short_in_a_terminal_and_a_table_in_a_notebook(tmp_path):
    rows = [{"agent": "mobil", "goal": 3}, {"agent": "random", "goal": 1}]
    run = Run(tmp_path, {"rows": rows, "config": {"seed": 0}})
    assert repr(run) == f"Run(folder={str(tmp_path)!r}, results: rows, config)"
    assert "random" in run._repr_html_()
    other = Run(tmp_path, {"dataset": "mine/first-v0", "decisions": 712, "config": {"seed": 0}})
    assert "<td>712</td>" in other._repr_html_()
