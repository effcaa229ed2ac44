"""Writes are atomic, also on a full disk.

Damage to any byte is refused.
"""

import errno
import os
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import torch
from PIL import Image
from reference.refusals import user_error
from reference.synthetic import synthetic_scenes
from safetensors.torch import save_file

from ganlane.agents import read_agent
from ganlane.agents.stored_models import read_description
from ganlane.data import read_scenes
from ganlane.data.recordings import write_prepared
from ganlane.errors import UserError
from ganlane.files import (
    CHECKPOINTS,
    PLACE,
    atomic_path,
    has_checksum,
    seal_archive,
    sealed,
    write_bytes,
)
from ganlane.generator import load_generator
from ganlane.realism.measures import SHIPPED_REFERENCE, Reference
from ganlane.training.checkpoint import load_checkpoint, save_checkpoint
from ganlane.weights import load_weights, save_weights

NOISE = np.random.default_rng(0).integers(0, 255, (200, 300, 3), dtype=np.uint8)
TABLE = pl.DataFrame({"a": NOISE.ravel()})


def savez(path: Path) -> None:
    with path.open("wb") as file:
        np.savez(file, a=NOISE)


#: Every library that writes files here; each has its own message for a full disk.
WRITERS = {
    "python": lambda path: path.write_bytes(NOISE.tobytes()),
    "polars, parquet": lambda path: TABLE.write_parquet(path, compression="uncompressed"),
    "polars, csv": lambda path: TABLE.write_csv(path),
    "torch": lambda path: torch.save({"a": torch.from_numpy(NOISE)}, path),
    "pillow": lambda path: Image.fromarray(NOISE).save(path, format="PNG"),
    "numpy": savez,
}


@pytest.mark.parametrize("writer", WRITERS)
def test_a_full_disk_is_told_of_in_the_systems_words_and_leaves_the_old_file(
    writer, tmp_path, room_on_disk
):
    path = tmp_path / "kept"
    write_bytes(path, b"old")
    room_on_disk(2**15)
    with pytest.raises(OSError, match="File too large") as caught, atomic_path(path) as part:
        WRITERS[writer](part)
    assert (caught.value.errno, caught.value.filename) == (errno.EFBIG, str(path))
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("mask", [0o022, 0o077])
def test_a_file_has_the_permissions_that_the_users_umask_leaves(mask, tmp_path):
    before = os.umask(mask)
    try:
        write_bytes(tmp_path / "a", b"")
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o666 & ~mask


def test_an_error_about_something_else_is_passed_on_as_it_is(tmp_path):
    for error, fail in (
        (ZeroDivisionError, lambda: 1 / 0),
        (FileNotFoundError, (tmp_path / "other").read_bytes),
    ):
        with pytest.raises(error) as caught, atomic_path(tmp_path / "a"):
            fail()
        assert getattr(caught.value, "filename", None) != str(tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_file_is_not_replaced(tmp_path):
    (tmp_path / "folder").mkdir()
    with user_error("folder: a folder, where a file was to be written"):
        write_bytes(tmp_path / "folder", b"new")
    if sys.platform != "win32":
        os.mkfifo(tmp_path / "pipe")
        with user_error("pipe: a device or a pipe, where a file"):
            write_bytes(tmp_path / "pipe", b"new")
        assert (tmp_path / "pipe").is_fifo()


# --- checksums


def copied(source: Path) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(source.read_bytes())


def synthetic_frame() -> pl.DataFrame:
    return synthetic_scenes(scenes=1, vehicles=4)


#: How every kind of file is written and read.
FILES: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {
    "agent.safetensors": (
        lambda path: save_weights(path, "agent", {"a": torch.arange(4.0)}, {"name": "x"}),
        lambda path: load_weights(path, "agent"),
    ),
    "shipped_agent.safetensors": (
        copied(CHECKPOINTS / "agent_idm.safetensors"),
        read_agent,
    ),
    "generator.safetensors": (
        copied(CHECKPOINTS / "generator_paper.safetensors"),
        load_generator,
    ),
    "reference.json": (
        lambda path: Reference.load(SHIPPED_REFERENCE).save(path),
        Reference.load,
    ),
    "last.pt": (
        lambda path: save_checkpoint(path, {"weights": torch.arange(40), "count": 4}),
        load_checkpoint,
    ),
    "scenes.parquet": (
        lambda path: write_prepared(synthetic_frame(), path),
        read_scenes,
    ),
}


def flipped(content: bytes, place: int, bit: int) -> bytes:
    return content[:place] + bytes([content[place] ^ (1 << bit)]) + content[place + 1 :]


@pytest.mark.parametrize("name", FILES)
def test_any_flipped_byte_is_refused_in_one_sentence(name, tmp_path, capsys):
    write, read = FILES[name]
    path = tmp_path / name
    write(path)
    read(path)
    whole = path.read_bytes()
    assert has_checksum(whole, path)
    # Both ends, where formats keep their headers, and places all over.
    places = {
        *range(0, 200, 29),
        *range(len(whole) - 120, len(whole), 19),
        *range(0, len(whole), len(whole) // 10),
    }
    for place in sorted(place for place in places if place < len(whole)):
        path.write_bytes(flipped(whole, place, place % 8))
        # Of an archive some damage is seen before its checksum is compared.
        with user_error(f"{name}: (damaged|not a readable checkpoint)") as caught:
            read(path)
        assert "\n" not in str(caught.value)
    for length in (0, 1, len(whole) // 2, len(whole) - len(PLACE), len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(UserError):
            read(path)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("where", ["in", "at"])
def test_no_bit_of_a_content_can_change(where, tmp_path):
    content = b"some content of a file, and two bytes\0\0"
    if where == "in":
        content = sealed(content + PLACE.encode() + content)
    else:
        archive = tmp_path / "archive"
        archive.write_bytes(content)
        seal_archive(archive)
        content = archive.read_bytes()
    assert has_checksum(content, "file")
    for place in range(len(content)):
        for bit in range(8):
            with user_error("file: damaged"):
                has_checksum(flipped(content, place, bit), "file")


def test_a_file_that_lost_its_checksum_is_refused(tmp_path):
    path = tmp_path / "agent.safetensors"
    save_file(
        {"a": torch.ones(2)},
        path,
        metadata={"ganlane": '{"kind": "agent"}'},
    )
    with user_error("the checksum that was written with it is missing"):
        load_weights(path, "agent")


def test_what_ships_has_checksums(capsys):
    for path in CHECKPOINTS.iterdir():
        assert path.stat().st_size < 5_000_000
        if path.suffix == ".zip":
            # The description beside a model holds the checksums of both.
            read_description(path)
        else:
            assert has_checksum(path.read_bytes(), path), path
    read_agent("agent_idm")
    assert capsys.readouterr().err == ""


def test_tables_of_other_programs_need_none(tmp_path, capsys):
    frame = synthetic_frame()
    frame.write_parquet(tmp_path / "own.parquet")
    assert read_scenes(tmp_path / "own.parquet").equals(frame)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(("kind", "value"), [("agent", "nan"), ("generator", "-inf")])
def test_weights_that_are_not_finite_are_refused(kind, value, tmp_path):
    path = tmp_path / "w.safetensors"
    save_weights(
        path,
        kind,
        {
            "fine": torch.ones(3),
            "layer.weight": torch.tensor([0.0, float(value)]),
        },
        {},
    )
    with user_error(r"w\.safetensors: layer\.weight holds numbers that are not finite"):
        load_weights(path, kind)


def test_a_content_without_the_place_cannot_be_sealed():
    with pytest.raises(ValueError, match="not found"):
        sealed(b"nothing")


@pytest.mark.parametrize("kind", ["weights", "histograms", "recordings", "checkpoint"])
def test_a_huge_file_is_refused_before_it_is_read(kind, tmp_path):
    path = tmp_path / "huge.parquet"
    with path.open("wb") as file:
        file.truncate(20 * 10**9)  # sparse: no bytes on the disk
    read = {
        "weights": lambda: load_weights(path, "agent"),
        "histograms": lambda: Reference.load(path),
        "recordings": lambda: read_scenes(path),
        "checkpoint": lambda: load_checkpoint(path),
    }
    with user_error(r"huge\.parquet: (more than|not a readable)"):
        read[kind]()
