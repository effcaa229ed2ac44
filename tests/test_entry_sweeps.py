"""Every run of a sweep has a folder of its own, whichever launcher starts it."""

import logging
from pathlib import Path

import entry_tiny
import pytest
from reference.processes import run
from reference.refusals import is_one_sentence, results_in

from ganlane.__main__ import main

TINY = [*entry_tiny.TINY, "evaluation.agents=[random_legal]"]
EVALUATE = ["evaluate", "-m", "seed=0,1", "traffics=[idm]", "episodes=2", "env.goal_m=40"]
#: Option of hydra/launcher to the package that brings it and what it is told beside.
LAUNCHERS = {
    "basic": ("hydra", []),
    "joblib": ("hydra_plugins.hydra_joblib_launcher", ["hydra.launcher.n_jobs=2"]),
    "submitit_local": ("hydra_plugins.hydra_submitit_launcher", ["hydra.launcher.timeout_min=5"]),
    "ray": ("hydra_plugins.hydra_ray_launcher", []),
}


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_the_runs_of_a_sweep_share_no_file(launcher, tmp_path):
    package, more = LAUNCHERS[launcher]
    pytest.importorskip(package, reason=f"hydra/launcher={launcher} needs {package}")
    words = ["-m", "seed=0,1", *TINY, f"hydra/launcher={launcher}", *more]
    done = run("-m", "ganlane", "train", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    (folder,) = (tmp_path / "outputs" / "train_sweeps").iterdir()
    runs = sorted(path for path in folder.iterdir() if path.is_dir() and path.name[0] != ".")
    assert [run.name for run in runs] == ["0", "1"]
    files = [
        {str(path.relative_to(run)) for path in run.rglob("*") if path.is_file()} for run in runs
    ]
    assert files[0] == files[1]
    assert files[0] >= {"checkpoints/last.pt", "config.yaml", "metrics.csv"}
    results = map(results_in, runs)
    told = [(result["config"]["seed"], result["decisions"]) for result in results]
    assert told == [(0, 320), (1, 320)]
    first, second = ((run / "agent.safetensors").read_bytes() for run in runs)
    assert first != second


@pytest.fixture
def own_logging(monkeypatch):
    """Hydra's log handlers, which write to this test's captured output, end with the test."""
    monkeypatch.setattr(logging.getLogger(), "handlers", [])


@pytest.mark.usefixtures("empty_folder", "own_logging")
def test_a_sweep_of_evaluate_has_a_folder_for_each_run_and_ends_with_one_table(capsys):
    assert main([*EVALUATE, "agents=[mobil,keep_lane]"]) == 0
    (folder,) = Path("outputs/evaluate_sweeps").iterdir()
    for seed in (0, 1):
        results = results_in(folder / str(seed))
        assert results["config"]["seed"] == seed
    table = capsys.readouterr().out.rpartition("results: ")[2]
    assert table.count("keep_lane") == 2
    assert "seed=0" in table
    assert "seed=1" in table
    assert f"sweep: {folder.absolute()}" in table


@pytest.mark.usefixtures("empty_folder", "own_logging")
def test_a_run_of_a_sweep_that_is_refused_ends_it_with_one_sentence(capsys):
    assert main([*EVALUATE, "agents=[missing.safetensors]"]) == 2
    assert is_one_sentence(capsys.readouterr().err, "evaluate")
    assert not list(Path("outputs").rglob("config.yaml"))
