"""Files damaged in every way that came to mind are refused in one sentence, and nothing in them is
executed.
"""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from reference.refusals import Bomb, everything_below, is_one_sentence, refusal, run_folder
from safetensors.torch import save

from ganlane.data import SyntheticTraffic, synthetic_scenes, write_scene_csv
from ganlane.files import CHECKPOINTS, seal_archive
from ganlane.native.library import libraries_folder
from ganlane.weights import load_weights, save_weights

ROOT = Path(__file__).resolve().parents[1]
AGENT, GENERATOR = (
    CHECKPOINTS / "agent_idm.safetensors",
    CHECKPOINTS / "generator_paper.safetensors",
)

pytestmark = pytest.mark.usefixtures("hydra_from_memory")


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """Commands run in a folder of their own, without recordings."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("GANLANE_DATA", raising=False)
    return tmp_path


# --- checkpoints


def damages(good: Path) -> dict[str, bytes]:
    """Checkpoints that will not do, by what is wrong with them; ``good`` is one of the right kind."""
    whole, sort = good.read_bytes(), "agent" if "agent" in good.name else "generator"
    weights = {"weight": torch.zeros(3)}
    _, metadata = load_weights(good, sort)
    return {
        "empty": b"",
        "noise": bytes(range(256)) * 16,
        "text": b"weights: none\n",
        "truncated": whole[: len(whole) // 2],
        "cut in its header": whole[:100],
        "a header that is too long": (2**62).to_bytes(8, "little") + b"{}",
        "longer than its header says": whole + b"more",
        "pickle": pickle.dumps(Bomb()),
        "torch pickle": saved({"kind": KIND, "version": 2, "state": Bomb()}),
        "foreign safetensors": save(weights),
        "other kind": written(save_weights, "something else", weights, {}),
        "no description": written(save_weights, sort, weights, {}),
        "other weights": written(save_weights, metadata.pop("kind"), weights, metadata),
    }


def written(write: Callable[..., None], *arguments: Any) -> bytes:
    """What a function writes to the path that it is given first."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "made")
        write(path, *arguments)
        return path.read_bytes()


def saved(content: Any) -> bytes:
    return written(lambda path: torch.save(content, path))


#: The command line of a stopped run.
IDM = "[traffic=idm]"
KIND = "ganlane training checkpoint"
DAMAGED = {good: damages(good) for good in (AGENT, GENERATOR)}
#: Where an agent's or a generator's file can stand on a command line.
PLACES = {
    "evaluate agents": (AGENT, ["evaluate", "agents=[broken.safetensors]"]),
    "evaluate agents, another ending": (AGENT, ["evaluate", "agents=[broken.pt]"]),
    "render agent": (AGENT, ["render", "agent=broken.safetensors"]),
    "train init": (
        AGENT,
        ["train", "traffic=idm", "init.path=broken.safetensors", "evaluation.agents=[mobil]"],
    ),
    "train generator": (GENERATOR, ["train", "traffic=gan", "generator.path=broken.safetensors"]),
    "evaluate generator": (
        GENERATOR,
        ["evaluate", "traffics=[gan]", "generator.path=broken.safetensors"],
    ),
}


#: Every damage once for an agent and once for a generator; elsewhere one of each sort.
COMBINATIONS = [
    (place, damage)
    for place in PLACES
    for damage in DAMAGED[AGENT]
    if place in ("evaluate agents", "evaluate generator")
    or damage in ("truncated", "torch pickle", "other kind")
]


@pytest.mark.parametrize(("place", "damage"), COMBINATIONS)
def test_a_broken_checkpoint_is_refused(place, damage, here, capsys):
    good, arguments = PLACES[place]
    content = DAMAGED[good][damage]
    for name in ("broken.safetensors", "broken.pt"):
        (here / name).write_bytes(content)
    assert "broken." in refusal(capsys, *arguments) or damage == "other weights"
    assert not (here / "executed").exists()


#: What the description of an agent's network could say by mistake or malice.
NETWORKS = {
    "hidden": [["many"], [-1], [10**9, 10**9], 3, []],
    "atoms": [0, -5, "many", 10**12],
    "observation_size": [-1, "wide", None],
    "actions": [0, 2.5],
    "v_min": ["low", 1e9],
    "noisy": ["perhaps"],
    "wheels": [4],
}


@pytest.mark.parametrize(
    ("name", "value"), [(name, value) for name, values in NETWORKS.items() for value in values]
)
def test_an_agent_with_an_impossible_network_is_refused(name, value, capsys):
    weights, metadata = load_weights(AGENT, "agent")
    del metadata["kind"]
    metadata["network"][name] = value
    save_weights("broken.safetensors", "agent", weights, metadata)
    short = ("traffics=[idm]", "episodes=1", "env.goal_m=20")
    assert "broken.safetensors" in refusal(
        capsys, "evaluate", "agents=[broken.safetensors]", *short
    )


@pytest.mark.parametrize(
    "damage", [kind for kind in DAMAGED[AGENT] if kind not in ("no description", "other weights")]
)
def test_a_broken_resume_checkpoint_is_refused(damage, here, capsys):
    run_folder(IDM, DAMAGED[AGENT][damage])
    assert "last.pt" in refusal(capsys, "train", "resume=run")
    assert not (here / "executed").exists()


@pytest.mark.parametrize(
    "content",
    [
        3,
        [],
        {},
        {"kind": KIND, "version": 1, "state": {}},
        {"kind": KIND, "version": 2},
        {"kind": KIND, "version": 2, "state": {}},
        {"kind": KIND, "version": 2, "state": 3},
    ],
    ids=str,
)
def test_a_resume_checkpoint_with_other_things_in_it_is_refused(content, capsys, tmp_path):
    (tmp_path / "other.pt").write_bytes(saved(content))
    seal_archive(tmp_path / "other.pt")  # without a checksum there is a note besides the sentence
    run_folder(IDM, (tmp_path / "other.pt").read_bytes())
    assert "resume" in refusal(capsys, "train", "resume=run")


@pytest.mark.parametrize(
    "overrides",
    ["", "3", "a: b: c", "[env.lanes=many]", "[unclosed", "\x00", "{a: 1}", "[{a: 1}]", "[1, 2]"],
    ids=repr,
)
def test_a_run_whose_command_line_is_damaged_is_not_resumed(overrides, capsys):
    run_folder(overrides)
    # The checkpoint would be refused as well: the sentence has to be about the command line.
    named = "env.lanes=many" if "env.lanes" in overrides else "overrides.yaml"
    assert named in refusal(capsys, "train", "resume=run")


# --- recordings and scenes


def damaged_recordings() -> dict[str, bytes]:
    """Scene CSVs with one fault each, or no CSV at all, by the fault."""
    text = written(
        lambda path: write_scene_csv(synthetic_scenes(SyntheticTraffic()), path)
    ).decode()
    header, _, rows = text.partition("\n")
    first, _, rest = rows.partition("\n")

    def with_cell(column: str, value: str) -> bytes:
        cells = first.split(",")
        cells[header.split(",").index(column)] = value
        return "\n".join([header, ",".join(cells), rest]).encode()

    return {
        "empty": b"",
        "noise": bytes(range(256)) * 16,
        "only a header": f"{header}\n".encode(),
        "no header": rows.encode(),
        "a column missing": f"{header.replace('lane', 'track')}\n{rows}".encode(),
        "a column twice": f"{header.replace(',y,', ',x,')}\n{rows}".encode(),
        "a word for a number": with_cell("x", "far"),
        "an empty cell": with_cell("x", ""),
        "not finite": with_cell("x", "nan"),
        "infinite": with_cell("v", "inf"),
        "a negative length": with_cell("length", "-4.5"),
        "a lane below the first": with_cell("lane", "-3"),
        "a cut line": f"{header}\n{first[:5]}\n".encode(),
        "a line too long": f"{header}\n{first},1,2,3\n{rest}".encode(),
        "a vehicle twice in a frame": f"{header}\n{first}\n{first}\n{rest}".encode(),
        "utf-16": text.encode("utf-16"),
        "parquet magic": b"PAR1" + b"\x00" * 64 + b"PAR1",
        "zipped": b"PK\x03\x04" + b"\x00" * 64,
    }


FAULTS = damaged_recordings()
#: Who reads a scene CSV.
READERS = {
    "prepare": ["prepare", "data.path=broken.csv"],
    "train_generator": ["train_generator", "data.path=broken.csv"],
    "realism": ["realism", "data.path=broken.csv", "quick=true"],
    "replay": ["evaluate", "traffics=[replay]", "traffic_options.replay.path=broken.csv"],
}


#: They read by the same function, so every fault once, and one of each sort for the others.
READINGS = [
    (reader, fault)
    for reader in READERS
    for fault in FAULTS
    if reader == "prepare" or fault in ("empty", "noise", "a column missing", "not finite")
]


@pytest.mark.parametrize(("reader", "fault"), READINGS)
def test_damaged_recordings_are_refused(reader, fault, here, capsys):
    (here / "broken.csv").write_bytes(FAULTS[fault])
    assert "broken.csv" in refusal(capsys, *READERS[reader])


@pytest.mark.parametrize("option", ["ngsim", "highd"])
@pytest.mark.parametrize(
    "fault", ["empty", "noise", "only a header", "a cut line", "utf-16", "parquet magic"]
)
def test_recordings_in_another_form_are_refused(option, fault, here, capsys):
    (here / "01_tracks.csv").write_bytes(FAULTS[fault])
    assert "01_" in refusal(capsys, "prepare", f"data={option}", "data.path=01_tracks.csv")


@pytest.mark.parametrize("arguments", READERS.values(), ids=READERS)
def test_a_folder_without_recordings_and_a_missing_file_are_refused(arguments, here, capsys):
    assert "broken.csv" in refusal(capsys, *arguments)
    (here / "broken.csv").mkdir()
    assert "broken.csv" in refusal(capsys, *arguments)


SCENE = "x_m,lane,speed_mps\n0,1,20\n40,1,20\n"
SCENE_FILES = {
    "empty.csv": b"",
    "header.csv": b"x_m,lane\n",
    "noise.csv": bytes(range(256)),
    "word.csv": SCENE.replace("40", "near").encode(),
    "column.csv": SCENE.replace("lane", "line").encode(),
    "nan.csv": SCENE.replace("40", "nan").encode(),
    "overlap.csv": SCENE.replace("40", "1").encode(),
    "half_a_lane.csv": SCENE.replace(",1,", ",1.5,").encode(),
    "backwards.csv": SCENE.replace("20", "-20").encode(),
    "alone.csv": b"x_m,lane\n0,1\n",
    "utf16.csv": SCENE.encode("utf-16"),
    "cut.json": b'[{"x_m": 0, "lane": 1}, {"x_m"',
    "number.json": b"3",
    "text.json": b'["here", "there"]',
    "lanes.json": json.dumps(
        {"lanes": -1, "vehicles": [{"x_m": 0, "lane": 0}, {"x_m": 40, "lane": 0}]}
    ).encode(),
    "many.json": json.dumps({"lanes": "many", "vehicles": [{"x_m": 0, "lane": 0}]}).encode(),
    "nothing.json": b'{"vehicles": null}',
    "deep.json": b"[" * 100_000,
    "scene.exe": SCENE.encode(),
    "field.csv": SCENE.replace("40", "1" * 10**6).encode(),
    "rows.csv": (SCENE + "40,1,20\n" * 200_000).encode(),
    "comment.csv": b"#" * 2**24 + SCENE.encode(),
    "far.csv": SCENE.replace("40", "1e308").encode(),
    "lane.csv": SCENE.replace(",1,", ",1e300,").encode(),
    "digits.json": f'[{{"x_m": 0, "lane": 1}}, {{"x_m": {"1" * 6000}, "lane": 1}}]'.encode(),
    "overflow.json": f'[{{"x_m": 0, "lane": 1}}, {{"x_m": {"1" * 4000}, "lane": 1}}]'.encode(),
    "seen.json": b'[{"x_m": 0, "lane": 1, "visibility": [1]}, {"x_m": 40, "lane": 1}]',
    "key.json": json.dumps({"k" * 10**6: 1, "vehicles": []}).encode(),
}


@pytest.mark.parametrize("name", SCENE_FILES)
def test_a_broken_scene_is_refused(name, here, capsys):
    (here / name).write_bytes(SCENE_FILES[name])
    told = refusal(
        capsys,
        "evaluate",
        "env=scene",
        f"env.scene.path={name}",
        "agents=[mobil]",
        "traffics=[idm]",
    )
    assert name in told
    assert len(told) < 1000


# --- whole commands

#: In a process of its own, once for a value and once for either kind of file;
#: a number out of range is in `test_entry_commands`.
WHOLE = (
    "prepare data=ngsim",
    "evaluate agents=[broken.safetensors] traffics=[idm]",
    "train resume=run",
)


@pytest.mark.parametrize(
    "line", [WHOLE[0], *(pytest.param(line, marks=pytest.mark.slow) for line in WHOLE[1:])]
)
def test_a_whole_command_ends_with_status_2(line, here):
    if "broken.safetensors" in line:
        Path("broken.safetensors").write_bytes(DAMAGED[AGENT]["pickle"])
    if "resume=run" in line:
        run_folder(IDM, DAMAGED[AGENT]["torch pickle"])
    before = everything_below(here)
    environment = {
        "PYTHONPATH": str(ROOT),
        "OMP_NUM_THREADS": "1",
        "PATH": "/usr/bin:/bin",
        "HOME": str(here),
    }
    # where the kernel is built already
    environment["GANLANE_CACHE"] = str(libraries_folder().parent)
    start = [sys.executable, "-m", "ganlane", *line.split()]
    done = subprocess.run(
        start, cwd=here, env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 2, done.stderr
    assert is_one_sentence(done.stderr, line.split()[0]), done.stderr
    assert done.stdout == ""
    assert everything_below(here) == before
