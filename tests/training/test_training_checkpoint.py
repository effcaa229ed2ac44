"""Checkpoint files: whole, truncated, foreign, and of version 0.1."""

import pytest
import torch
from tensordict import TensorDict

from ganlane.errors import UserError
from ganlane.training.checkpoint import load_checkpoint, save_checkpoint
from ganlane.training.collectors import pack, unpack


def test_a_checkpoint_comes_back_as_it_was(tmp_path):
    save_checkpoint(tmp_path / "last.pt", {"weights": torch.arange(3), "count": 4})
    state = load_checkpoint(tmp_path / "last.pt")
    assert state["count"] == 4
    assert torch.equal(state["weights"], torch.arange(3))
    assert [path.name for path in tmp_path.iterdir()] == ["last.pt"]


def test_names_of_version_0_1_are_read_as_those_of_today(tmp_path):
    save_checkpoint(tmp_path / "last.pt", {"carrier": 1, "meter": 2, "counters": {"owed": 3, "best": None}})
    expected = {"env_state": 1, "stats": 2, "counters": {"pending_decisions": 3, "best": None}}
    assert load_checkpoint(tmp_path / "last.pt") == expected


@pytest.mark.parametrize("cut", [0, 10, 200, 700])
def test_a_truncated_checkpoint_is_refused(cut, tmp_path):
    path = tmp_path / "last.pt"
    save_checkpoint(path, {"weights": torch.arange(1000)})
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(UserError, match="not a readable checkpoint"):
        load_checkpoint(path)


def test_foreign_files_are_refused(tmp_path):
    path = tmp_path / "other.pt"
    torch.save({"model": torch.zeros(3)}, path)
    with pytest.raises(UserError, match="not a ganlane training checkpoint"):
        load_checkpoint(path)
    path.write_text("a text file")
    with pytest.raises(UserError, match="not a readable checkpoint"):
        load_checkpoint(path)
    with pytest.raises(UserError, match="no such file"):
        load_checkpoint(tmp_path / "absent.pt")


def test_a_file_that_would_run_code_is_refused(tmp_path):
    class Sly:
        def __reduce__(self):
            return (open, (str(tmp_path / "made"), "w"))

    torch.save({"kind": "ganlane training checkpoint", "state": Sly()}, tmp_path / "sly.pt")
    with pytest.raises(UserError, match="not a readable checkpoint"):
        load_checkpoint(tmp_path / "sly.pt")
    assert not (tmp_path / "made").exists()


def test_a_tensordict_is_packed_with_its_nested_batch_sizes():
    inner = TensorDict({"a": torch.zeros(2, 3, 1)}, [2, 3])
    whole = TensorDict({"inner": inner, "b": torch.ones(2)}, [2])
    back = unpack(pack(whole))
    assert back["inner"].batch_size == (2, 3)
    assert (back == whole).all()


def test_one_changed_byte_anywhere_is_refused(tmp_path):
    path = tmp_path / "last.pt"
    save_checkpoint(path, {"weights": torch.arange(40), "count": 4})
    whole = path.read_bytes()
    for place in (*range(0, len(whole), 13), *range(len(whole) - 110, len(whole))):
        changed = bytearray(whole)
        changed[place] ^= 1 << place % 8
        path.write_bytes(changed)
        with pytest.raises(UserError, match=r"^resume=.*last\.pt: .*; give another one\.$|, its content .* one\.$"):
            load_checkpoint(path)
    path.write_bytes(whole[: -len(SEAL) - 64])  # the checksum cut off altogether
    with pytest.raises(UserError, match="damaged"):
        load_checkpoint(path)


def test_a_checkpoint_of_a_version_without_checksums_is_read_with_a_note(tmp_path, capsys):
    path = tmp_path / "last.pt"
    torch.save({"kind": "ganlane training checkpoint", "version": 2, "state": {"count": 4}}, path)
    assert load_checkpoint(path) == {"count": 4}
    note_without_checksum(path)
    assert "wrote no checksum, damage would not be seen" in capsys.readouterr().err
    save_checkpoint(path, {"count": 4})
    note_without_checksum(path)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("part", ["network", "target", "optimizer"])
def test_weights_that_are_not_finite_are_refused(part, value, tmp_path):
    state = {"agent": {part: {"state": {0: {"exp_avg": torch.tensor([1.0, value])}}}}}
    save_checkpoint(tmp_path / "last.pt", state)
    with pytest.raises(UserError, match=f"numbers of its {part} are not finite"):
        load_checkpoint(tmp_path / "last.pt")
