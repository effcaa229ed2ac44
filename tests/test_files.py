"""Writes are atomic, also on a full disk; in a document only the part between two markers is rewritten."""

from __future__ import annotations

import errno
import os
import sys

import numpy as np
import polars as pl
import pytest
import torch
from PIL import Image

from ganlane.errors import UserError
from ganlane.files import atomic_path, split_at_markers, write_between_markers, write_bytes, write_json

BEGIN, END = "<!-- begin -->", "<!-- end -->"


def test_what_stands_between_the_markers_is_rewritten_and_the_rest_is_kept(tmp_path):
    document = tmp_path / "page.md"
    document.write_text(f"# Title\n{BEGIN}{END} tail é\n", encoding="utf-8")
    for content in ("one", "two\nlines"):
        write_between_markers(document, BEGIN, END, content)
        assert document.read_text(encoding="utf-8") == f"# Title\n{BEGIN}\n{content}\n{END} tail é\n"
    assert split_at_markers(document, BEGIN, END) == (f"# Title\n{BEGIN}", f"{END} tail é\n")


@pytest.mark.parametrize("text", ["", BEGIN, END, f"{END}{BEGIN}", f"{BEGIN}{END}{END}", f"{BEGIN}{BEGIN}{END}"])
def test_a_document_without_both_markers_once_and_in_order_is_refused_and_kept(tmp_path, text):
    document = tmp_path / "page.md"
    document.write_text(text)
    with pytest.raises(UserError, match=r"page\.md: expected the lines <!-- begin --> and <!-- end -->"):
        write_between_markers(document, BEGIN, END, "new")
    assert document.read_text() == text


def test_a_missing_document_is_refused_and_not_made(tmp_path):
    with pytest.raises(UserError, match=r"gone\.md: no such file"):
        write_between_markers(tmp_path / "gone.md", BEGIN, END, "new")
    assert list(tmp_path.iterdir()) == []


NOISE = np.random.default_rng(0).integers(0, 255, (200, 300, 3), dtype=np.uint8)
TABLE = pl.DataFrame({"a": NOISE.ravel()})
#: Every library that writes files here; each has its own message for a full disk.
WRITERS = {
    "python": lambda path: path.write_bytes(NOISE.tobytes()),
    "polars, parquet": lambda path: TABLE.write_parquet(path, compression="uncompressed"),
    "polars, csv": lambda path: TABLE.write_csv(path),
    "torch": lambda path: torch.save({"a": torch.from_numpy(NOISE)}, path),
    "pillow": lambda path: Image.fromarray(NOISE).save(path, format="PNG"),
    "numpy": lambda path: np.savez(path.open("wb"), a=NOISE),
}


@pytest.fixture
def small_disk():
    """No file may grow beyond 32 KiB: the same errors as on a full disk, with another errno."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**15, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("writer", WRITERS)
def test_a_full_disk_is_told_of_in_the_systems_words_and_leaves_the_old_file(writer, tmp_path, small_disk):
    path = tmp_path / "kept"
    write_bytes(path, b"old")
    with pytest.raises(OSError, match="File too large") as caught, atomic_path(path) as part:
        WRITERS[writer](part)
    assert (caught.value.errno, caught.value.filename) == (errno.EFBIG, str(path))
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EIO])
def test_a_refusal_without_a_name_gets_that_of_the_file(number, tmp_path):
    with pytest.raises(OSError, match=os.strerror(number)) as caught, atomic_path(tmp_path / "a") as part:  # noqa: PT012
        part.write_bytes(b"half")
        raise OSError(number, os.strerror(number))
    assert (caught.value.errno, caught.value.filename) == (number, str(tmp_path / "a"))
    assert list(tmp_path.iterdir()) == []


def test_an_error_about_something_else_is_passed_on_as_it_is(tmp_path):
    for error, fail in ((ZeroDivisionError, lambda: 1 / 0), (FileNotFoundError, (tmp_path / "other").read_bytes)):
        with pytest.raises(error) as caught, atomic_path(tmp_path / "a"):
            fail()
        assert getattr(caught.value, "filename", None) != str(tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_a_file_is_refused(tmp_path):
    write_bytes(tmp_path / "file", b"here")
    with pytest.raises((NotADirectoryError, FileExistsError)):
        write_json(tmp_path / "file" / "a", 1)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_what_is_no_file_is_not_replaced(tmp_path):
    (tmp_path / "folder").mkdir()
    with pytest.raises(UserError, match="folder: a folder, where a file was to be written"):
        write_bytes(tmp_path / "folder", b"new")
    if sys.platform != "win32":
        os.mkfifo(tmp_path / "pipe")
        with pytest.raises(UserError, match="pipe: a device or a pipe, where a file"):
            write_bytes(tmp_path / "pipe", b"new")
        assert (tmp_path / "pipe").is_fifo()


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="the administrator may write anywhere")
def test_a_folder_without_the_right_to_write_is_refused(tmp_path):
    tmp_path.chmod(0o555)
    try:
        with pytest.raises(PermissionError) as caught:
            write_bytes(tmp_path / "a", b"new")
        assert caught.value.filename == str(tmp_path / "a")
    finally:
        tmp_path.chmod(0o755)
