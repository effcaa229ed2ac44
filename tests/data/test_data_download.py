"""Where recordings are, and downloads from a server that breaks off, ignores Range or changes its file."""

from __future__ import annotations

import errno
import sys
from pathlib import Path

import pytest
from reference.file_server import CONTENT, SHA256, Server

from ganlane.data import byte_progress, data_folder, default_scenes, download
from ganlane.errors import UserError

QUICK = {"timeout_s": 5.0, "attempts": 3, "wait_s": 0.01}


def fetch(server, path, sha256=None, **settings):
    return download(server.url, path, sha256, **QUICK, **settings)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_file_arrives_whole_with_progress(tmp_path):
    steps = []
    with Server() as server:
        path = download(server.url, tmp_path / "new" / "f", SHA256, lambda *step: steps.append(step), **QUICK)
    assert path.read_bytes() == CONTENT
    assert names(path.parent) == ["f"]
    assert steps[-1] == (len(CONTENT), len(CONTENT))
    assert [done for done, _ in steps] == sorted(done for done, _ in steps)


@pytest.mark.parametrize(
    ("server", "ranges"),
    [
        ({"breaks": [300_000, 500_000]}, [None, "bytes=300000-", "bytes=800000-"]),
        ({"breaks": [300_000], "ranges": False}, [None, "bytes=300000-"]),
        ({"breaks": [300_000], "etag": None}, [None, None]),
    ],
    ids=["resumed", "server ignores Range", "no version"],
)
def test_a_broken_transfer_resumes_only_where_server_and_version_allow(server, ranges, tmp_path):
    with Server(**server) as running:
        assert fetch(running, tmp_path / "f", SHA256).read_bytes() == CONTENT
    assert running.asked == ranges


def test_a_later_run_resumes_what_an_earlier_one_left(tmp_path):
    with Server(breaks=[400_000, 0, 0, 0]) as server:
        with pytest.raises(UserError, match=r"cannot be fetched, 400000 bytes came .*continues from there"):
            fetch(server, tmp_path / "f", SHA256)
        assert "f" not in names(tmp_path)
        server.breaks = []
        fetch(server, tmp_path / "f", SHA256)
    assert server.asked[-1] == "bytes=400000-"
    assert (tmp_path / "f").read_bytes() == CONTENT
    assert names(tmp_path) == ["f"]


@pytest.mark.parametrize(("content", "etag"), [(CONTENT[::-1], '"two"'), (CONTENT[:1000], None)])
def test_a_part_of_another_version_or_longer_than_the_file_is_discarded(content, etag, tmp_path):
    with Server(breaks=[300_000, 0, 0, 0]) as server:
        with pytest.raises(UserError, match="cannot be fetched"):
            fetch(server, tmp_path / "f")
        server.content, server.etag, server.breaks = content, etag or server.etag, []
        assert fetch(server, tmp_path / "f").read_bytes() == content
    assert names(tmp_path) == ["f"]


def test_a_corrupt_transfer_leaves_nothing(tmp_path):
    with Server(content=CONTENT[:-1] + b"?") as server, pytest.raises(UserError) as caught:
        fetch(server, tmp_path / "f", SHA256.upper())
    assert "its SHA-256 is" in str(caught.value)
    assert SHA256 in str(caught.value)
    assert names(tmp_path) == []


def test_a_file_that_is_there_is_kept_and_compared(tmp_path):
    path = tmp_path / "f"
    path.write_bytes(CONTENT)
    with Server() as server:
        assert fetch(server, path, SHA256) == path
        assert server.asked == []
        with pytest.raises(UserError, match=r"remove it, or correct data\.sha256"):
            fetch(server, path, "0" * 64)
    assert path.read_bytes() == CONTENT


def test_a_refused_request_is_reported_at_once(tmp_path):
    with Server(status=404) as server:
        with pytest.raises(UserError, match=r"the server says 404 Not Found; check data.url"):
            fetch(server, tmp_path / "f")
        assert len(server.asked) == 1
    with pytest.raises(UserError, match="not an address"):
        download("file:///etc/hostname", tmp_path / "f")
    assert names(tmp_path) == []


def test_a_failing_server_is_tried_again_and_an_absent_one_is_named(tmp_path):
    with Server(status=503) as server:
        with pytest.raises(UserError, match=r"0 bytes came \(503"):
            fetch(server, tmp_path / "f")
        assert len(server.asked) == QUICK["attempts"]
    with pytest.raises(UserError, match=r"0 bytes came \(.*refused"):
        fetch(server, tmp_path / "f")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_a_full_disk_is_reported_at_once_and_not_as_a_network_error(tmp_path):
    (tmp_path / ".f.part").symlink_to("/dev/full")
    with Server() as server, pytest.raises(OSError, match="No space left") as caught:
        fetch(server, tmp_path / "f", SHA256)
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(tmp_path / "f"))
    assert len(server.asked) == 1


def test_a_disk_error_of_the_part_names_the_file(tmp_path):
    (tmp_path / ".f.part").mkdir()
    with Server() as server, pytest.raises(IsADirectoryError) as caught:
        fetch(server, tmp_path / "f", SHA256)
    assert caught.value.filename == str(tmp_path / "f")
    assert len(server.asked) == 1


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_shows_bytes_on_a_terminal_and_nothing_of_short_work_elsewhere(terminal, capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    with byte_progress("read") as show:
        show(2_000_000, 4_000_000)
    err = capsys.readouterr().err
    assert ("read:  50%" in err and "2.00M/4.00M" in err) if terminal else err == ""


def test_the_recordings_are_found_through_the_variable(tmp_path, monkeypatch):
    monkeypatch.setenv("GANLANE_DATA", str(tmp_path))
    assert data_folder() == tmp_path
    with pytest.raises(UserError, match=r"set GANLANE_DATA to a folder that holds ngsim/us101_scenes\.csv"):
        default_scenes()
    (tmp_path / "ngsim").mkdir()
    deep = tmp_path / "ngsim" / "us101_scenes.csv"
    deep.write_text("scene,vehicle")
    assert default_scenes() == deep
    monkeypatch.setenv("GANLANE_DATA", str(tmp_path / "nowhere"))
    with pytest.raises(UserError, match="no such folder"):
        data_folder()


def test_the_recordings_are_found_beside_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.delenv("GANLANE_DATA", raising=False)
    module = sys.modules["ganlane.data.download"]
    monkeypatch.setattr(module, "__file__", str(tmp_path / "site" / "ganlane" / "data" / "download.py"))
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    assert data_folder() is None
    (tmp_path / "shared" / "data").mkdir(parents=True)
    assert data_folder() == tmp_path / "shared" / "data"


@pytest.mark.parametrize("length", ["abc", "-5", "", "1e3"])
def test_an_invalid_content_length_is_ignored(length, tmp_path):
    with Server(length=length) as server:
        assert fetch(server, tmp_path / "f", SHA256).read_bytes() == CONTENT


@pytest.mark.parametrize("length", [True, False, "9" * 5000])
def test_a_file_larger_than_wanted_is_refused_and_leaves_nothing(length, tmp_path):
    with Server(length=length) as server, pytest.raises(UserError, match=r"the file has .* GB or more"):
        fetch(server, tmp_path / "f", most_bytes=len(CONTENT) - 1)
    assert names(tmp_path) == []


@pytest.mark.parametrize("place", ["ftp://here/f", "file:///etc/hostname", "data:,f", "http://[::1"])
def test_no_redirection_leads_away_from_http(place, tmp_path):
    with Server(sends_to=place) as server, pytest.raises(UserError, match=r"not allowed|expected http|Invalid"):
        fetch(server, tmp_path / "f")
    assert "f" not in names(tmp_path)


def test_a_redirection_on_http_is_followed(tmp_path):
    with Server() as server, Server(sends_to=server.url) as first:
        assert fetch(first, tmp_path / "f", SHA256).read_bytes() == CONTENT
