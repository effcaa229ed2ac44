"""Whatever is broken, a command ends with status 2 and one sentence, without a traceback, and leaves nothing behind.

Wrong configuration values are made from the dataclasses: every key gets a value of a wrong type, and every key that
has a range one outside of it, once. Files are damaged in every way that came to mind.
"""

from __future__ import annotations

import dataclasses
import json
import math
import pickle
import subprocess
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import pytest
import torch
from omegaconf import OmegaConf
from reference.hydra_memory import composed, own_part
from safetensors.torch import save_file

from ganlane.__main__ import COMMANDS, main
from ganlane.checksums import seal_archive
from ganlane.config.command_line import typed
from ganlane.config.schemas import SCHEMAS
from ganlane.data import SyntheticTraffic, synthetic_scenes, write_scene_csv
from ganlane.errors import UserError
from ganlane.files import CHECKPOINTS, conf_folder, load_weights, save_weights
from ganlane.native.library import cache_folder
from ganlane.parameters.checks import NO_KEY

ROOT = Path(__file__).resolve().parents[1]
AGENT, GENERATOR = CHECKPOINTS / "agent_idm.safetensors", CHECKPOINTS / "generator_paper.safetensors"


pytestmark = pytest.mark.usefixtures("hydra_from_memory")


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """Commands run in a folder of their own, without recordings."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("GANLANE_DATA", raising=False)
    return tmp_path


def everything_below(folder: Path) -> dict[str, int]:
    """Every file and folder with its size."""
    return {str(path.relative_to(folder)): path.stat().st_size for path in folder.rglob("*")}


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The sentence with which a command line is refused, after all that it must not do was looked for."""
    before = everything_below(Path.cwd())
    status = main(arguments)
    out, err = capsys.readouterr()
    assert status == 2, (arguments, out, err)
    assert is_one_sentence(err, arguments[0]), err
    assert everything_below(Path.cwd()) == before
    return err


def is_one_sentence(err: str, command: str) -> bool:
    """One line that names the command and ends in a full stop; no traceback."""
    return (
        err.startswith(f"ganlane {command}: ")
        and err.endswith(".\n")
        and err.count("\n") == 1
        and "Traceback" not in err
    )


# --- configuration values


@dataclasses.dataclass(frozen=True)
class Key:
    """A key of a command as its dataclass declares it; ``chosen`` are the options that it belongs to."""

    command: str
    name: str
    kind: Any
    chosen: tuple[str, ...] = ()

    def __str__(self) -> str:
        return " ".join((self.command, *self.chosen, self.name))


def keys_of(config: Any, command: str, chosen: tuple[str, ...] = (), prefix: str = "") -> Iterator[Key]:
    """All keys below a dataclass, with their declared types."""
    kinds = get_type_hints(type(config))
    for field in dataclasses.fields(config):
        value, name = getattr(config, field.name), f"{prefix}{field.name}"
        if field.metadata == NO_KEY:
            continue
        if dataclasses.is_dataclass(value):
            yield from keys_of(value, command, chosen, f"{name}.")
        elif isinstance(value, dict) and any(map(dataclasses.is_dataclass, value.values())):
            for part, below in value.items():
                yield from keys_of(below, command, chosen, f"{name}.{part}.")
        else:
            yield Key(command, name, kinds[field.name], chosen)


def keys_of_options() -> Iterator[Key]:
    """The keys that options have beside those of the default of their group."""
    homes = {"data": "prepare", "generator": "train_generator"}
    scene = str(ROOT / "tests" / "reference" / "scene.csv")
    needs = {
        "env=scene": (f"env.scene.path={scene}",),
        "data=ngsim": ("data.path=x",),
        "data=highd": ("data.path=x",),
    }
    for group, option in [(group, option) for group, options in SCHEMAS.items() if group for option in options]:
        command, name = homes.get(group, "train"), f"{group}={option}"
        # The forms of the observation share one schema, which is not an option.
        if group == "observation" or not (conf_folder() / group / f"{option}.yaml").is_file():
            continue
        chosen = (name, *needs.get(name, ()))
        known = {key.name for key in KEYS if key.command == command}
        for key in keys_of(option_of(command, group, option, chosen), command, chosen, f"{group}."):
            if key.name not in known:
                yield key


def option_of(command: str, group: str, option: str, chosen: tuple[str, ...]) -> Any:
    """What an option's dataclass holds; composing takes hundreds of times as long, so only where it has to be."""
    try:
        return SCHEMAS[group][option]()
    except UserError:
        return getattr(typed(in_memory(Key(command, "", None, chosen))), group)


def in_memory(key: Key, *more: tuple[str, Any]) -> Any:
    """The configuration that a key belongs to, with more of its keys set."""
    options = tuple(each for each in key.chosen if (conf_folder() / each.partition("=")[0]).is_dir())
    config = own_part(composed(key.command, options))
    given = [tuple(each.split("=", 1)) for each in key.chosen if each not in options]
    for name, value in [*given, *more]:
        OmegaConf.update(config, name, value)
    return config


TYPED = {command: typed(own_part(composed(command))) for command in COMMANDS}
KEYS = [key for command, config in TYPED.items() for key in keys_of(config, command)]
OPTION_KEYS = list(keys_of_options())


def plain_kind(kind: Any) -> Any:
    """``int`` for ``int | None``, ``list`` for ``list[str]``."""
    if get_origin(kind) in (Union, types.UnionType):
        kind = next(part for part in get_args(kind) if part is not type(None))
    return get_origin(kind) or kind


#: What no key of a kind takes.
WRONG_TYPE = {int: "many", float: "many", bool: "perhaps", str: "[a,b]", list: "{a:1}", tuple: "{a:1}", dict: "3"}
#: What a key of a kind with a range could refuse, the likeliest first.
ABSURD: dict[Any, tuple[Any, ...]] = {
    int: (-(10**9), 10**15, 0),
    float: (-1e9, 0.0, 1e15, math.nan),
    str: ("no-such-value", ""),
    list: ([], ["no-such-value"], [-1, -2], [math.nan, 1.0]),
}


def with_value(config: Any, names: list[str], value: Any) -> Any:
    """A copy of a dataclass in which a key, however deep, has another value; its ranges are checked."""
    first, *deeper = names
    if isinstance(config, dict):
        return {**config, first: with_value(config[first], deeper, value)}
    below = with_value(getattr(config, first), deeper, value) if deeper else value
    return dataclasses.replace(config, **{first: below})


def refused_in_memory(key: Key, value: Any) -> bool:
    """Whether the dataclasses refuse the value; some thousand times as fast as the command."""
    try:
        if not key.chosen:
            with_value(TYPED[key.command], key.name.split("."), value)
        else:
            group, option = key.chosen[0].split("=")
            config = option_of(key.command, group, option, key.chosen)
            with_value(config, key.name.split(".")[1:], value)
    except (UserError, TypeError):  # of the wrong kind altogether: Hydra looks at no range
        return True
    return not is_list_of_kind(key.kind, value)


def is_list_of_kind(kind: Any, value: Any) -> bool:
    """Whether a list holds what it is declared to hold; anything else passes."""
    kinds = [part for part in (kind, *get_args(kind)) if get_origin(part) is list]
    wanted = get_args(kinds[0])[0] if kinds else str
    return wanted is str or not isinstance(value, list) or all(isinstance(each, (int, float)) for each in value)


def as_typed(value: Any) -> str:
    """A value as it is given on the command line."""
    if isinstance(value, list):
        return f"[{','.join(map(as_typed, value))}]"
    return "''" if value == "" else str(value)


@pytest.mark.parametrize("key", KEYS + OPTION_KEYS, ids=str)
def test_a_key_refuses_a_wrong_type(key, capsys):
    wrong = WRONG_TYPE.get(plain_kind(key.kind), "3")
    assert key.name.rsplit(".", 1)[-1] in refusal(capsys, key.command, *key.chosen, f"{key.name}={wrong}")


def absurd_value(key: Key) -> Any:
    """A value of the right type that the key refuses; None if it takes them all."""
    return next((value for value in ABSURD.get(plain_kind(key.kind), ()) if refused_in_memory(key, value)), None)


#: Every key that has a range once, and the value outside of it: the ranges are those of the dataclass, whichever
#: command it belongs to.
OUT_OF_RANGE = {
    name: (key, value)
    for name, key in {key.name: key for key in KEYS + OPTION_KEYS}.items()
    if (value := absurd_value(key)) is not None
}


@pytest.mark.parametrize("name", sorted(OUT_OF_RANGE))
def test_a_key_refuses_what_is_out_of_range(name, capsys):
    key, value = OUT_OF_RANGE[name]
    err = refusal(capsys, key.command, *key.chosen, f"{name}={as_typed(value)}")
    assert name.rsplit(".", 1)[-1] in err or str(value) in err


def test_nearly_every_number_has_a_range():
    numbers = {key.name for key in KEYS + OPTION_KEYS if plain_kind(key.kind) in (int, float)}
    assert len(numbers) > 100
    assert numbers <= OUT_OF_RANGE.keys()
    assert len(KEYS + OPTION_KEYS) + len(OUT_OF_RANGE) > 400


# --- checkpoints


class Bomb:
    """Unpickling it makes a file named ``exploded``."""

    def __reduce__(self):
        return open, ("exploded", "w")


def damaged(kind: str, good: Path) -> bytes:
    """The bytes of a checkpoint that will not do; ``good`` is one of the right kind."""
    path = Path("made")
    whole = good.read_bytes()
    if kind == "pickle":
        return pickle.dumps(Bomb())
    if kind == "torch pickle":
        torch.save({"kind": "ganlane training checkpoint", "version": 2, "state": Bomb()}, path)
    elif kind == "foreign safetensors":
        save_file({"weight": torch.zeros(3)}, path)
    elif kind == "other kind":
        save_weights(path, "something else", {"weight": torch.zeros(3)}, {})
    elif kind == "no description":
        save_weights(path, load_kind(good), {"weight": torch.zeros(3)}, {})
    elif kind == "other weights":
        _, metadata = load_weights(good, load_kind(good))
        save_weights(path, metadata.pop("kind"), {"weight": torch.zeros(3)}, metadata)
    if path.exists():
        content = path.read_bytes()
        path.unlink()
        return content
    return {
        "empty": b"",
        "noise": bytes(range(256)) * 16,
        "text": b"weights: none\n",
        "truncated": whole[: len(whole) // 2],
        "cut in its header": whole[:100],
        "a header that is too long": (2**62).to_bytes(8, "little") + b"{}",
        "longer than its header says": whole + b"more",
    }[kind]


def load_kind(path: Path) -> str:
    """Agent or generator."""
    return "agent" if "agent" in path.name else "generator"


DAMAGES = (
    "empty",
    "noise",
    "text",
    "truncated",
    "cut in its header",
    "a header that is too long",
    "longer than its header says",
    "pickle",
    "torch pickle",
    "foreign safetensors",
    "other kind",
    "no description",
    "other weights",
)
#: Where an agent's or a generator's file can stand on a command line.
PLACES = {
    "evaluate agents": (AGENT, ["evaluate", "agents=[broken.safetensors]"]),
    "evaluate agents, another ending": (AGENT, ["evaluate", "agents=[broken.pt]"]),
    "render agent": (AGENT, ["render", "agent=broken.safetensors"]),
    "train init": (AGENT, ["train", "traffic=idm", "init.path=broken.safetensors", "evaluation.agents=[mobil]"]),
    "train generator": (GENERATOR, ["train", "traffic=gan", "generator.path=broken.safetensors"]),
    "evaluate generator": (
        GENERATOR,
        ["evaluate", "agents=[mobil]", "traffics=[gan]", "generator.path=broken.safetensors"],
    ),
}


#: Every damage once for an agent and once for a generator; elsewhere one of each sort.
COMBINATIONS = [
    (place, damage)
    for place in PLACES
    for damage in DAMAGES
    if place in ("evaluate agents", "evaluate generator") or damage in ("truncated", "torch pickle", "other kind")
]


@pytest.mark.parametrize(("place", "damage"), COMBINATIONS)
def test_a_broken_checkpoint_is_refused(place, damage, here, capsys):
    good, arguments = PLACES[place]
    content = damaged(damage, good)
    for name in ("broken.safetensors", "broken.pt"):
        (here / name).write_bytes(content)
    assert "broken." in refusal(capsys, *arguments) or damage == "other weights"
    assert not (here / "exploded").exists()


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


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in NETWORKS.items() for value in values])
def test_an_agent_with_an_impossible_network_is_refused(name, value, capsys):
    weights, metadata = load_weights(AGENT, "agent")
    del metadata["kind"]
    save_weights(
        "broken.safetensors", "agent", weights, {**metadata, "network": {**metadata["network"], name: value}}
    )
    short = ("traffics=[idm]", "episodes=1", "env.goal_m=20")
    assert "broken.safetensors" in refusal(capsys, "evaluate", "agents=[broken.safetensors]", *short)


def run_folder(checkpoint: bytes, overrides: str = "[traffic=idm]") -> Path:
    """What a stopped training run leaves."""
    folder = Path("run")
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "checkpoints" / "last.pt").write_bytes(checkpoint)
    (folder / "overrides.yaml").write_text(overrides)
    return folder


@pytest.mark.parametrize("damage", [kind for kind in DAMAGES if kind not in ("no description", "other weights")])
def test_a_broken_resume_checkpoint_is_refused(damage, here, capsys):
    run_folder(damaged(damage, AGENT))
    assert "last.pt" in refusal(capsys, "train", "resume=run")
    assert not (here / "exploded").exists()


KIND = "ganlane training checkpoint"


def saved(content: Any) -> bytes:
    torch.save(content, "made")
    whole = Path("made").read_bytes()
    Path("made").unlink()
    return whole


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
    run_folder((tmp_path / "other.pt").read_bytes())
    assert "resume" in refusal(capsys, "train", "resume=run")


@pytest.mark.parametrize(
    "overrides",
    ["", "3", "a: b: c", "[env.lanes=many]", "[unclosed", "\x00", "{a: 1}", "[{a: 1}]", "[1, 2]"],
    ids=repr,
)
def test_a_run_whose_command_line_is_damaged_is_not_resumed(overrides, capsys):
    run_folder(b"", overrides)
    # The checkpoint would be refused as well: the sentence has to be about the command line.
    named = "env.lanes=many" if "env.lanes" in overrides else "overrides.yaml"
    assert named in refusal(capsys, "train", "resume=run")


# --- recordings and scenes


def scenes_csv() -> str:
    """Recordings made up, as a scene CSV."""
    path = Path("made.csv")
    write_scene_csv(synthetic_scenes(SyntheticTraffic()), path)
    text = path.read_text()
    path.unlink()
    return text


SCENES_CSV: list[str] = []


def damaged_recordings(kind: str) -> bytes:
    """A scene CSV with one fault, or no CSV at all."""
    if not SCENES_CSV:
        SCENES_CSV.append(scenes_csv())
    header, _, rows = SCENES_CSV[0].partition("\n")
    first, _, rest = rows.partition("\n")
    cells = first.split(",")
    cell = header.split(",").index

    def with_cell(column: str, value: str) -> bytes:
        changed = [*cells[: cell(column)], value, *cells[cell(column) + 1 :]]
        return "\n".join([header, ",".join(changed), rest]).encode()

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
        "utf-16": SCENES_CSV[0].encode("utf-16"),
        "parquet magic": b"PAR1" + b"\x00" * 64 + b"PAR1",
        "zipped": b"PK\x03\x04" + b"\x00" * 64,
    }[kind]


FAULTS = (
    "empty",
    "noise",
    "only a header",
    "no header",
    "a column missing",
    "a column twice",
    "a word for a number",
    "an empty cell",
    "not finite",
    "infinite",
    "a negative length",
    "a lane below the first",
    "a cut line",
    "a line too long",
    "a vehicle twice in a frame",
    "utf-16",
    "parquet magic",
    "zipped",
)
#: Who reads a scene CSV.
READERS = {
    "prepare": ["prepare", "data.path=broken.csv"],
    "train_generator": ["train_generator", "data.path=broken.csv"],
    "realism": ["realism", "data.path=broken.csv", "quick=true"],
    "replay": [
        "evaluate",
        "agents=[mobil]",
        "traffics=[replay]",
        "traffic_options.replay.path=broken.csv",
        "episodes=1",
    ],
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
    (here / "broken.csv").write_bytes(damaged_recordings(fault))
    assert "broken.csv" in refusal(capsys, *READERS[reader])


@pytest.mark.parametrize("option", ["ngsim", "highd"])
@pytest.mark.parametrize("fault", ["empty", "noise", "only a header", "a cut line", "utf-16", "parquet magic"])
def test_recordings_in_another_form_are_refused(option, fault, here, capsys):
    (here / "01_tracks.csv").write_bytes(damaged_recordings(fault))
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
    "lanes.json": json.dumps({"lanes": -1, "vehicles": [{"x_m": 0, "lane": 0}, {"x_m": 40, "lane": 0}]}).encode(),
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
    told = refusal(capsys, "evaluate", "env=scene", f"env.scene.path={name}", "agents=[mobil]", "traffics=[idm]")
    assert name in told
    assert len(told) < 1000


# --- whole commands

#: As a user types them, each refused by another part of the package.
LINES = (
    "train env.lane=3",
    "train seed=zero",
    "train total_decisions=-1",
    "train traffic=ganny",
    "train resume=nowhere",
    "evaluate agents=[mobil,mobil]",
    "render format=avi",
    "train_generator folds=1",
)


@pytest.mark.parametrize("line", LINES)
def test_a_mistake_is_refused(line, capsys):
    assert refusal(capsys, *line.split())


#: The same in a process of its own, once for a value and once for either kind of file;
#: a number out of range is in `test_entry_commands`.
WHOLE = (
    "prepare data=ngsim",
    "evaluate agents=[broken.safetensors] traffics=[idm]",
    "train resume=run",
)


@pytest.mark.parametrize("line", WHOLE)
def test_a_whole_command_ends_with_status_2(line, here):
    if "broken.safetensors" in line:
        Path("broken.safetensors").write_bytes(damaged("pickle", AGENT))
    if "resume=run" in line:
        run_folder(damaged("torch pickle", AGENT))
    before = everything_below(here)
    environment = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PATH": "/usr/bin:/bin", "HOME": str(here)}
    environment["GANLANE_CACHE"] = str(cache_folder().parent)  # where the kernel is built already
    start = [sys.executable, "-m", "ganlane", *line.split()]
    done = subprocess.run(start, cwd=here, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2, done.stderr
    assert is_one_sentence(done.stderr, line.split()[0]), done.stderr
    assert done.stdout == ""
    assert everything_below(here) == before
