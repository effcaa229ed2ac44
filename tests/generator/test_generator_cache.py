import numpy as np
import pytest

from ganlane.generator.cache import VARIABLE, cache_folder, cached, content_hash


class Count:
    """Computes the same arrays and counts how often."""

    def __init__(self):
        self.calls = 0

    def __call__(self):
        self.calls += 1
        return {"labels": np.arange(5), "more": np.ones((2, 3))}


def test_what_was_computed_once_is_not_computed_again(monkeypatch, tmp_path):
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    compute = Count()
    first = cached("groups", "key", compute)
    again = cached("groups", "key", compute)
    assert compute.calls == 1
    assert first.keys() == again.keys()
    assert all((first[name] == again[name]).all() for name in first)
    cached("groups", "another", compute)
    assert compute.calls == 2


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 half a file", b"something else"])
def test_a_damaged_file_is_computed_again(monkeypatch, tmp_path, damage):
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    compute = Count()
    cached("groups", "key", compute)
    (file,) = tmp_path.iterdir()
    file.write_bytes(damage)
    assert (cached("groups", "key", compute)["labels"] == np.arange(5)).all()
    assert compute.calls == 2
    cached("groups", "key", compute)
    assert compute.calls == 2


def test_a_folder_that_cannot_be_written_to_is_done_without(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv(VARIABLE, str(tmp_path / "file"))
    assert (cached("groups", "key", Count())["labels"] == np.arange(5)).all()


def test_an_empty_name_switches_the_cache_off_and_none_takes_the_users_folder(monkeypatch, tmp_path):
    monkeypatch.setenv(VARIABLE, "")
    assert cache_folder() is None
    monkeypatch.delenv(VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "ganlane"


def test_the_hash_sees_settings_values_shapes_and_types():
    values = np.arange(6.0)
    hashes = {
        content_hash({"size": 9}, values),
        content_hash({"size": 8}, values),
        content_hash({"size": 9}, values + 1e-9),
        content_hash({"size": 9}, values.reshape(2, 3)),
        content_hash({"size": 9}, values.astype(np.float32)),
        content_hash({"size": 9}, values, values),
    }
    assert len(hashes) == 6
    assert content_hash({"a": 1, "b": 2}, values) == content_hash({"b": 2, "a": 1}, values.copy())
