"""Files that say what they may not are refused in one sentence, and nothing in them is executed.

Random damage to their bytes is in tests/trial.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from reference.refusals import Bomb, refusal, run_folder
from safetensors.torch import save_file

from ganlane.data import SyntheticTraffic, synthetic_scenes, write_scene_csv
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


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("hidden", ["many"]),
        ("hidden", [-1]),
        ("hidden", [10**9, 10**9]),
        ("hidden", 3),
        ("atoms", -5),
        ("atoms", 10**12),
        ("observation_size", None),
        ("actions", 2.5),
        ("v_min", 1e9),
        ("noisy", ["perhaps"]),
        ("wheels", 4),
    ],
)
def test_an_agent_with_an_impossible_network_is_refused(name, value, capsys):
    weights, metadata = load_weights(CHECKPOINTS / f"{AGENT}.safetensors", "agent")
    del metadata["kind"]
    metadata["network"][name] = value
    save_weights("broken.safetensors", "agent", weights, metadata)
    line = "evaluate agents=[broken.safetensors] traffics=[idm] episodes=1 env.goal_m=20"
    assert "broken.safetensors" in refusal(capsys, *line.split())


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


@pytest.mark.parametrize(
    "config", ["", "a: b: c", "env: {lanes: many}", "{unclosed", "\x00", "[{a: 1}]", "3"], ids=repr
)
def test_a_run_whose_settings_are_damaged_is_not_resumed(config, capsys):
    run_folder(config)
    # The checkpoint would be refused as well: the sentence has to be about the settings.
    named = "env.lanes=many" if "env" in config else "config.yaml"
    assert named in refusal(capsys, "train", "resume=run")


# --- recordings and scenes


#: Scene CSVs: what is done to the column of the first row, or to the lines.
CELLS = [
    ("x", "far"),
    ("x", ""),
    ("x", "nan"),
    ("v", "inf"),
    ("length", "-4.5"),
    ("lane", "-3"),
]
LINES = {
    "empty": lambda head, rows: [],
    "only a header": lambda head, rows: [head],
    "no header": lambda head, rows: rows,
    "a column missing": lambda head, rows: [head.replace("lane", "track"), *rows],
    "a column twice": lambda head, rows: [head.replace(",y,", ",x,"), *rows],
    "a vehicle twice in a frame": lambda head, rows: [head, rows[0], *rows],
}
#: Who reads a scene CSV, all by the same function.
READERS = [
    "prepare data.path=broken.csv",
    "train_generator data.path=broken.csv",
    "realism data.path=broken.csv quick=true",
    "evaluate traffics={replay:{name:replay,path:broken.csv}}",
]


@pytest.fixture
def recording():
    """Header and rows of a good one."""
    write_scene_csv(synthetic_scenes(SyntheticTraffic()), Path("good.csv"))
    head, *rows = Path("good.csv").read_text().splitlines()
    Path("good.csv").unlink()
    return head, rows


@pytest.mark.parametrize(("column", "value"), CELLS)
def test_a_cell_that_no_recording_has_is_refused(column, value, recording, capsys):
    head, rows = recording
    cells = rows[0].split(",")
    cells[head.split(",").index(column)] = value
    Path("broken.csv").write_text("\n".join([head, ",".join(cells), *rows[1:]]))
    assert "broken.csv" in refusal(capsys, *READERS[0].split())


@pytest.mark.parametrize("fault", LINES)
def test_a_table_that_is_no_recording_is_refused(fault, recording, capsys):
    Path("broken.csv").write_text("\n".join(LINES[fault](*recording)))
    assert "broken.csv" in refusal(capsys, *READERS[0].split())


@pytest.mark.parametrize("line", READERS)
def test_no_recordings_are_refused_whoever_reads_them(line, capsys):
    assert "broken.csv" in refusal(capsys, *line.split())
    Path("broken.csv").write_text("x,y\n")
    assert "broken.csv" in refusal(capsys, *line.split())
    Path("broken.csv").unlink()
    Path("broken.csv").mkdir()
    assert "broken.csv" in refusal(capsys, *line.split())


@pytest.mark.parametrize("option", ["ngsim", "highd"])
@pytest.mark.parametrize("content", [b"", b"x,y\n", "x,y\n1,2\n".encode("utf-16")])
def test_recordings_in_another_form_are_refused(option, content, capsys):
    Path("01_tracks.csv").write_bytes(content)
    assert "01_" in refusal(capsys, "prepare", f"data={option}", "data.path=01_tracks.csv")


SCENE = "x_m,lane,speed_mps\n0,1,20\n40,1,20\n"
PLACE = {"x_m": 0, "lane": 0}
SCENE_FILES = {
    "header.csv": "x_m,lane\n",
    "alone.csv": "x_m,lane\n0,1\n",
    "word.csv": SCENE.replace("40", "near"),
    "column.csv": SCENE.replace("lane", "line"),
    "nan.csv": SCENE.replace("40", "nan"),
    "far.csv": SCENE.replace("40", "1e308"),
    "overlap.csv": SCENE.replace("40", "1"),
    "half_a_lane.csv": SCENE.replace(",1,", ",1.5,"),
    "lane.csv": SCENE.replace(",1,", ",1e300,"),
    "backwards.csv": SCENE.replace("20", "-20"),
    "rows.csv": SCENE + "40,1,20\n" * 200_000,
    "scene.exe": SCENE,
    "number.json": "3",
    "text.json": '["here", "there"]',
    "nothing.json": '{"vehicles": null}',
    "lanes.json": json.dumps({"lanes": -1, "vehicles": [PLACE, {"x_m": 40, "lane": 0}]}),
    "many.json": json.dumps({"lanes": "many", "vehicles": [PLACE]}),
    "seen.json": json.dumps([{**PLACE, "visibility": [1]}, {"x_m": 40, "lane": 1}]),
    "overflow.json": json.dumps([PLACE, {"x_m": 10**4000, "lane": 1}]),
}


@pytest.mark.parametrize("name", SCENE_FILES)
def test_a_broken_scene_is_refused(name, capsys):
    Path(name).write_text(SCENE_FILES[name])
    line = f"evaluate env=scene env.scene.path={name} agents=[mobil] traffics=[idm]"
    told = refusal(capsys, *line.split())
    assert name in told
    assert len(told) < 1000
