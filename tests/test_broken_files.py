"""Files that say what they may not are refused in one sentence, and nothing in them is executed.

Random damage to their bytes is in tests/trial.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from reference.refusals import Bomb, refusal, run_folder
from safetensors.torch import save_file

from ganlane.files import CHECKPOINTS, seal_archive
from ganlane.weights import load_weights, save_weights

AGENT, GENERATOR = "agent_idm", "generator_paper"
KIND = "ganlane training checkpoint"


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """Commands run in a folder of their own, without recordings; nothing may be executed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("GANLANE_DATA", raising=False)
    yield tmp_path
    assert not (tmp_path / "executed").exists()


# --- weights


def truncated(path: str, good: Path) -> None:
    content = good.read_bytes()
    Path(path).write_bytes(content[: len(content) // 2])


def foreign(path: str, good: Path) -> None:
    save_file({"weight": torch.zeros(3)}, path)


def other_kind(path: str, good: Path) -> None:
    save_weights(path, "something else", {"weight": torch.zeros(3)}, {})


def no_description(path: str, good: Path) -> None:
    save_weights(path, good.stem.partition("_")[0], {"weight": torch.zeros(3)}, {})


def other_weights(path: str, good: Path) -> None:
    kind = good.stem.partition("_")[0]
    _, metadata = load_weights(good, kind)
    del metadata["kind"]
    save_weights(path, kind, {"weight": torch.zeros(3)}, metadata)


def pickled(path: str, good: Path) -> None:
    torch.save({"kind": KIND, "version": 2, "state": Bomb()}, path)


DAMAGES = (truncated, foreign, other_kind, no_description, other_weights, pickled)
#: Where an agent's or a generator's file can stand on a command line.
PLACES = {
    "evaluate agents=[broken.safetensors]": AGENT,
    "evaluate traffics={gan:{name:gan,path:broken.safetensors}}": GENERATOR,
    "evaluate agents=[broken.pt]": AGENT,
    "render agent=broken.safetensors": AGENT,
    "train traffic=idm init.path=broken.safetensors evaluation.agents=[mobil]": AGENT,
    "train traffic=gan traffic.path=broken.safetensors": GENERATOR,
}
#: Every damage once for an agent and once for a generator; elsewhere one.
FIRST_TWO = [(line, damage) for line in list(PLACES)[:2] for damage in DAMAGES]


@pytest.mark.parametrize(
    ("line", "damage"), FIRST_TWO + [(line, pickled) for line in list(PLACES)[2:]]
)
def test_broken_weights_are_refused(line, damage, capsys):
    for name in ("broken.safetensors", "broken.pt"):
        damage(name, CHECKPOINTS / f"{PLACES[line]}.safetensors")
    assert "broken." in refusal(capsys, *line.split()) or damage is other_weights


# --- runs


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"weights: none\n",
        3,
        {"kind": KIND, "version": 1, "state": {}},
        {"kind": KIND, "version": 2, "state": {}},
        {"kind": KIND, "version": 2, "state": Bomb()},
    ],
    ids=("empty", "text", "number", "old version", "no state", "pickle"),
)
def test_a_broken_state_of_a_run_is_refused(content: Any, capsys, tmp_path):
    file = tmp_path / "other.pt"
    if isinstance(content, bytes):
        file.write_bytes(content)
    else:
        torch.save(content, file)
        seal_archive(file)  # without a checksum there is a note besides the sentence
    run_folder("traffic: idm", file.read_bytes())
    assert "resume" in refusal(capsys, "train", "resume=run")


# --- recordings and scenes


#: Who reads a scene CSV, all by the same function.
READERS = [
    "prepare data.path=broken.csv",
    "train_generator data.path=broken.csv",
    "realism data.path=broken.csv quick=true",
    "evaluate traffics={replay:{name:replay,path:broken.csv}}",
]


@pytest.mark.parametrize("line", READERS)
def test_no_recordings_are_refused_whoever_reads_them(line, capsys):
    assert "broken.csv" in refusal(capsys, *line.split())
    Path("broken.csv").write_text("x,y\n")
    assert "broken.csv" in refusal(capsys, *line.split())
    Path("broken.csv").unlink()
    Path("broken.csv").mkdir()
    assert "broken.csv" in refusal(capsys, *line.split())
