"""``ganlane bench`` from end to end, with very short measurements, in process."""

from __future__ import annotations

import json
import platform
from pathlib import Path

import pytest
import torch
from ganlane.bench import main
from reference.refusals import last_path, refusal

TINY = [
    "quick=true",
    "batches=[1,3]",
    "seconds=0.001",
    "vehicle_counts=[4,6]",
    "scaling_batch=2",
    "linear_from=1",
]
LABELS = {
    "suite",
    "system",
    "traffic",
    "mode",
    "dtype",
    "device",
    "threads",
    "vehicles",
    "lanes",
    "batch",
}
RATES = {"physics_steps_per_s", "decisions_per_s", "vehicle_steps_per_s", "peak_memory_mb"}
TIMES = {"wall_s", "cpu_s", "repetitions", "spread", "ratio", "ratio_cpu"}
pytestmark = pytest.mark.usefixtures("empty_folder")


def run(capsys, *arguments):
    """What is printed, and the results."""
    assert main([*TINY, "peers=false", "devices=[cpu]", *arguments]) == 0
    out = capsys.readouterr().out
    return out, json.loads(last_path(out).read_text())


def test_rows_findings_and_provenance_are_kept(capsys):
    out, results = run(capsys, "modes=[eager]")
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
    run(capsys, "modes=[eager]", f"report={document}")
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
    _, results = run(capsys, "suite=train", *small, f"report={document}")
    assert [speed["traffic"] for speed in results["speeds"]] == ["idm_mobil", "gan"]
    assert {"rows", "config"} <= results.keys()
    text = document.read_text()
    assert "| ganlane training | idm_mobil | eager | cpu | 1 | 4 |" in text


@pytest.mark.parametrize("suite", ["sim", "traffic", "train"])
def test_the_document_of_the_project_can_be_written(suite):
    text = (Path(__file__).parents[1] / "docs/performance.md").read_text()
    assert (
        text.count(f"<!-- begin bench {suite} -->")
        == text.count(f"<!-- end bench {suite} -->")
        == 1
    )


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_a_gpu_that_is_not_there_is_refused(capsys):
    assert "no CUDA device" in refusal(capsys, "bench", "devices=[cpu,cuda]")
