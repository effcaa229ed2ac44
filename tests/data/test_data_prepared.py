"""A folder that is whole or absent, and whose errors name what the user named."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from ganlane.data.prepared import whole_folder
from ganlane.files import write_bytes

TOO_LONG = "s" * 300


@pytest.fixture(params=["absolute", "relative"])
def out(request, tmp_path, monkeypatch):
    """Where the folder is to be, as a user may give it."""
    monkeypatch.chdir(tmp_path)
    return (tmp_path if request.param == "absolute" else Path()) / "scenes"


def test_a_refused_file_is_named_as_in_the_folder_to_be(out):
    with pytest.raises(OSError, match="too long") as caught, whole_folder(out) as folder:
        write_bytes(folder / TOO_LONG, b"")
    assert (caught.value.errno, caught.value.filename) == (errno.ENAMETOOLONG, str(out / TOO_LONG))
    assert list(Path.cwd().iterdir()) == []


def test_a_refusal_about_the_folder_names_it(out):
    with pytest.raises(FileExistsError) as caught, whole_folder(out) as folder:
        folder.mkdir()
    assert caught.value.filename == str(out)


def test_a_folder_that_cannot_be_made_is_named(out):
    long = out.with_name(TOO_LONG[:250])  # the hidden one beside it has a longer name
    with pytest.raises(OSError, match="too long") as caught, whole_folder(long):
        raise AssertionError("nothing to write into")
    assert (caught.value.errno, caught.value.filename) == (errno.ENAMETOOLONG, str(long))


@pytest.mark.parametrize("name", ["scenes.csv", ".hidden/scenes.csv", None])
def test_other_files_keep_their_names(out, name):
    with pytest.raises(FileNotFoundError) as caught, whole_folder(out):
        raise FileNotFoundError(errno.ENOENT, "No such file or directory", name)
    assert caught.value.filename == name
