"""Damage to any byte of a file that is written and read back is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import polars as pl
import pytest
import torch
from safetensors.torch import save_file

from ganlane.agents import read_agent
from ganlane.checksums import PLACE, has_checksum, sealed, sealed_archive
from ganlane.data import SyntheticTraffic, read_scenes, synthetic_scenes
from ganlane.data.scenes import write_prepared
from ganlane.errors import UserError
from ganlane.files import CHECKPOINTS
from ganlane.generator import load_generator
from ganlane.generator.fit import FitLoop
from ganlane.generator.windows import cached, load_arrays, save_arrays
from ganlane.parameters.generator import LoopConfig, PaperConfig
from ganlane.realism.measures import SHIPPED_REFERENCE, Reference
from ganlane.weights import load_weights, save_weights


class SmallFit:
    """The smallest model that a loop can fit."""

    config = PaperConfig(loop=LoopConfig(updates=1, evaluate_every=1))

    def __init__(self):
        self.modules = {"net": torch.nn.Linear(2, 2)}
        self.optimisers = {"net": torch.optim.Adam(self.modules["net"].parameters())}
        self.random = torch.Generator()

    def update(self, number: int) -> dict[str, float]:
        return {}

    def evaluate(self) -> float:
        return 0.0


def fit(path: Path) -> FitLoop:
    return FitLoop(SmallFit(), path)


def copied(source: Path) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(source.read_bytes())


def synthetic_frame() -> pl.DataFrame:
    return synthetic_scenes(SyntheticTraffic(scenes=1, vehicles=4))


#: How every kind of file is written and read.
FILES: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {
    "agent.safetensors": (
        lambda path: save_weights(path, "agent", {"a": torch.arange(4.0)}, {"name": "x"}),
        lambda path: load_weights(path, "agent"),
    ),
    "shipped_agent.safetensors": (copied(CHECKPOINTS / "agent_idm.safetensors"), read_agent),
    "generator.safetensors": (copied(CHECKPOINTS / "generator_paper.safetensors"), load_generator),
    "reference.json": (lambda path: Reference.load(SHIPPED_REFERENCE).save(path), Reference.load),
    "fit.pt": (lambda path: fit(path).run(), fit),
    "scenes.parquet": (lambda path: write_prepared(synthetic_frame(), path), read_scenes),
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
    places = {*range(0, 200, 9), *range(len(whole) - 120, len(whole), 7), *range(0, len(whole), len(whole) // 40)}
    for place in sorted(place for place in places if place < len(whole)):
        path.write_bytes(flipped(whole, place, place % 8))
        with pytest.raises(UserError, match=f"{path.name}: damaged") as caught:
            read(path)
        assert "\n" not in str(caught.value)
    for length in (0, 1, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(UserError):
            read(path)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "seal", [lambda text: sealed(text + PLACE.encode() + text), sealed_archive], ids=["in", "at"]
)
def test_no_bit_of_a_content_can_change(seal):
    content = seal(b"some content of a file, and two bytes\0\0")
    assert has_checksum(content, "file")
    for place in range(len(content)):
        for bit in range(8):
            with pytest.raises(UserError, match="file: damaged"):
                has_checksum(flipped(content, place, bit), "file")


def test_a_damaged_cache_is_computed_again(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("GANLANE_CACHE", str(tmp_path))
    compute = Mock(side_effect=lambda: {"labels": np.arange(3)})
    for _ in range(2):
        assert cached("groups", "key", compute)["labels"].tolist() == [0, 1, 2]
    assert compute.call_count == 1
    path = tmp_path / "groups_key.npz"
    whole = path.read_bytes()
    for place in range(len(whole)):
        path.write_bytes(flipped(whole, place, place % 8))
        assert load_arrays(path) is None
    assert capsys.readouterr().err.count("computed again") == len(whole)
    assert cached("groups", "key", compute)["labels"].tolist() == [0, 1, 2]
    assert (compute.call_count, path.read_bytes()) == (2, whole)
    np.savez_compressed(path, labels=np.arange(4))  # as older versions wrote it
    assert cached("groups", "key", compute)["labels"].tolist() == [0, 1, 2]
    save_arrays(path, {"labels": np.arange(5)})
    assert cached("groups", "key", compute)["labels"].tolist() == [0, 1, 2, 3, 4]


def test_an_old_file_loads_with_one_note(tmp_path, capsys):
    path = tmp_path / "old.safetensors"
    save_file({"a": torch.ones(2)}, path, metadata={"ganlane": '{"kind": "agent"}'})
    for _ in range(3):
        load_weights(path, "agent")
    note = f"{path}: of a version that wrote no checksum; damage to it would not be seen.\n"
    assert capsys.readouterr().err == note


def test_what_ships_has_checksums(capsys):
    for path in CHECKPOINTS.iterdir():
        assert path.stat().st_size < 5_000_000
        assert has_checksum(path.read_bytes(), path), path
    read_agent("agent_idm")
    assert capsys.readouterr().err == ""


def test_tables_of_other_programs_need_none(tmp_path, capsys):
    frame = synthetic_frame()
    frame.write_parquet(tmp_path / "own.parquet")
    assert read_scenes(tmp_path / "own.parquet").equals(frame)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("kind", ["agent", "generator"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_weights_that_are_not_finite_are_refused(kind, value, tmp_path):
    path = tmp_path / "w.safetensors"
    save_weights(path, kind, {"fine": torch.ones(3), "layer.weight": torch.tensor([0.0, value])}, {})
    with pytest.raises(UserError, match=r"w\.safetensors: layer\.weight holds numbers that are not finite"):
        load_weights(path, kind)


def test_a_content_without_the_place_cannot_be_sealed():
    with pytest.raises(ValueError, match="not found"):
        sealed(b"nothing")
