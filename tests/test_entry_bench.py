"""``ganlane bench`` from end to end, with very short measurements, in process."""

from __future__ import annotations

import json
import platform
from pathlib import Path

import pytest
import torch

from ganlane.bench import main

TINY = ["quick=true", "batches=[1,3]", "seconds=0.001", "vehicle_counts=[4,6]", "scaling_batch=2", "linear_from=1"]
LABELS = {"suite", "system", "traffic", "mode", "dtype", "device", "threads", "vehicles", "lanes", "batch"}
RATES = {"physics_steps_per_s", "decisions_per_s", "vehicle_steps_per_s", "peak_memory_mb"}
TIMES = {"wall_s", "cpu_s", "repetitions", "spread", "ratio", "ratio_cpu"}


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def run(capsys, *arguments):
    """Exit status, stdout, stderr."""
    status = main([*TINY, *arguments])
    return status, *capsys.readouterr()


def test_rows_findings_and_provenance_are_kept(capsys):
    status, out, _ = run(capsys, "modes=[eager]", "peers=false", "devices=[cpu]")
    assert status == 0
    last = out.splitlines()[-1]
    results = json.loads(Path(last.removeprefix("results: ")).read_text())
    assert results["rows"][0].keys() >= LABELS | RATES | TIMES
    speed = [row for row in results["rows"] if row["part"] == "speed"]
    assert [row["batch"] for row in speed] == [1, 1, 3, 3]
    assert {row["threads"] for row in speed} == {1}
    assert all(row["physics_steps_per_s"] > 0 for row in results["rows"])
    assert [(growth["in"], growth["sizes"]) for growth in results["scaling"]] == [
        ("batch", [1, 3]),
        ("batch", [1, 3]),
        ("vehicles", [4, 6]),
        ("vehicles", [4, 6]),
    ]
    assert 100 < results["memory"]["state_bytes"] < 50_000
    assert {"ratios", "notes", "config", "code", "machine", "seeds"} <= results.keys()
    assert "physics steps/s" in out


def test_report_rewrites_the_tables_of_a_document(tmp_path, capsys):
    document = tmp_path / "speed.md"
    document.write_text("before\n<!-- begin bench sim -->\n<!-- end bench sim -->\nafter\n")
    status, _, _ = run(capsys, "modes=[eager]", "peers=false", "devices=[cpu]", f"report={document}")
    assert status == 0
    text = document.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "python -m ganlane.bench quick=true 'batches=[1,3]'" in text
    assert "| ganlane physics | eager | cpu | 1 | 3 |" in text
    assert str(tmp_path) not in text
    assert platform.node() not in text.split()


def test_training_is_measured_and_reported(tmp_path, capsys):
    document = tmp_path / "speed.md"
    document.write_text("<!-- begin bench train -->\n<!-- end bench train -->\n")
    small = ["train_batches=[4]", "agent.hidden=[8]", "agent.batch_size=8", "train_stored=16"]
    status, out, _ = run(capsys, "suite=train", "peers=false", "devices=[cpu]", *small, f"report={document}")
    assert status == 0
    results = json.loads(Path(out.splitlines()[-1].removeprefix("results: ")).read_text())
    assert [speed["traffic"] for speed in results["speeds"]] == ["idm_mobil", "gan"]
    assert {"rows", "config"} <= results.keys()
    text = document.read_text()
    assert "| ganlane training | idm_mobil | eager | cpu | 1 | 4 |" in text


@pytest.mark.usefixtures("hydra_from_memory")
@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["report=unmarked.md"], "once each"),
        (["report=gone.md"], "report=gone.md: no such file"),
        (["batches=[1,1]"], "a list of different entries"),
        (["suite=train", "train_traffics=[nobody]"], "train_traffics=nobody"),
        (["suite=train", "train_stored=9"], "train_stored=9: expected at least agent.batch_size=256"),
        (["memory_batches=[8,8]"], "two batch sizes, the smaller one first"),
        (["env.vehicles=100"], "env.vehicles=100 do not fit"),
    ],
)
def test_a_mistake_ends_in_one_sentence_and_leaves_nothing(arguments, part, tmp_path, capsys):
    (tmp_path / "unmarked.md").write_text("nothing")
    status, out, err = run(capsys, *arguments)
    assert (status, out) == (2, "")
    assert part in err
    assert "Traceback" not in err
    assert [path.read_text() for path in tmp_path.iterdir()] == ["nothing"]


@pytest.mark.parametrize("suite", ["sim", "traffic", "train"])
def test_the_document_of_the_project_can_be_written(suite):
    text = (Path(__file__).parents[1] / "docs/performance.md").read_text()
    assert text.count(f"<!-- begin bench {suite} -->") == text.count(f"<!-- end bench {suite} -->") == 1


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_a_gpu_that_is_not_there_is_refused(capsys):
    status, _, err = run(capsys, "devices=[cpu,cuda]")
    assert status == 2
    assert "no CUDA device" in err
