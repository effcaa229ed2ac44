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


def test_a_broken_transfer_goes_on_where_it_ended(tmp_path):
    with Server(breaks=[300_000, 500_000]) as server:
        path = download(server.url, tmp_path / "f", SHA256, None, **QUICK)
    assert path.read_bytes() == CONTENT
    assert server.asked == [None, "bytes=300000-", "bytes=800000-"]


def test_a_later_run_goes_on_with_what_an_earlier_one_left(tmp_path):
    with Server(breaks=[400_000, 0, 0, 0]) as server:
        with pytest.raises(UserError, match=r"cannot be fetched, 400000 bytes came .*continues from there"):
            download(server.url, tmp_path / "f", SHA256, None, **QUICK)
        assert "f" not in names(tmp_path)
        server.breaks = []
        download(server.url, tmp_path / "f", SHA256, None, **QUICK)
    assert server.asked[-1] == "bytes=400000-"
    assert (tmp_path / "f").read_bytes() == CONTENT
    assert names(tmp_path) == ["f"]


def test_a_server_that_ignores_range_sends_everything_again(tmp_path):
    with Server(breaks=[300_000], ranges=False) as server:
        path = download(server.url, tmp_path / "f", SHA256, None, **QUICK)
    assert path.read_bytes() == CONTENT
    assert server.asked == [None, "bytes=300000-"]


def test_without_a_version_parts_are_never_joined(tmp_path):
    with Server(breaks=[300_000], etag=None) as server:
        path = download(server.url, tmp_path / "f", None, None, **QUICK)
    assert path.read_bytes() == CONTENT
    assert server.asked == [None, None]


def test_a_file_that_changed_meanwhile_is_not_joined_to_the_old_part(tmp_path):
    with Server(breaks=[300_000, 0, 0, 0]) as server:
        with pytest.raises(UserError, match="cannot be fetched"):
            download(server.url, tmp_path / "f", None, None, **QUICK)
        server.content, server.etag, server.breaks = CONTENT[::-1], '"two"', []
        assert download(server.url, tmp_path / "f", None, None, **QUICK).read_bytes() == CONTENT[::-1]


def test_a_part_longer_than_the_file_is_thrown_away(tmp_path):
    with Server(breaks=[300_000, 0, 0, 0]) as server:
        with pytest.raises(UserError):
            download(server.url, tmp_path / "f", None, None, **QUICK)
        server.content, server.breaks = CONTENT[:1000], []
        assert download(server.url, tmp_path / "f", None, None, **QUICK).read_bytes() == CONTENT[:1000]
    assert names(tmp_path) == ["f"]


def test_a_corrupt_transfer_leaves_nothing(tmp_path):
    with Server(content=CONTENT[:-1] + b"?") as server, pytest.raises(UserError) as caught:
        download(server.url, tmp_path / "f", SHA256.upper(), None, **QUICK)
    assert "its SHA-256 is" in str(caught.value)
    assert SHA256 in str(caught.value)
    assert names(tmp_path) == []


def test_a_file_that_is_there_is_kept_and_compared(tmp_path):
    path = tmp_path / "f"
    path.write_bytes(CONTENT)
    with Server() as server:
        assert download(server.url, path, SHA256, None, **QUICK) == path
        assert server.asked == []
        with pytest.raises(UserError, match=r"remove it, or correct data\.sha256"):
            download(server.url, path, "0" * 64, None, **QUICK)
    assert path.read_bytes() == CONTENT


def test_what_the_server_refuses_is_told_at_once(tmp_path):
    with Server(status=404) as server:
        with pytest.raises(UserError, match=r"the server says 404 Not Found; check data.url"):
            download(server.url, tmp_path / "f", None, None, **QUICK)
        assert len(server.asked) == 1
    with pytest.raises(UserError, match="not an address"):
        download("file:///etc/hostname", tmp_path / "f")
    assert names(tmp_path) == []


def test_a_server_in_trouble_is_asked_again_and_one_that_is_gone_is_named(tmp_path):
    with Server(status=503) as server:
        with pytest.raises(UserError, match=r"0 bytes came \(503"):
            download(server.url, tmp_path / "f", None, None, **QUICK)
        assert len(server.asked) == QUICK["attempts"]
    with pytest.raises(UserError, match=r"0 bytes came \(.*refused"):
        download(server.url, tmp_path / "f", None, None, **QUICK)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_a_full_disk_is_told_at_once_and_not_as_a_fault_of_the_network(tmp_path):
    (tmp_path / ".f.part").symlink_to("/dev/full")
    with Server() as server, pytest.raises(OSError, match="No space left") as caught:
        download(server.url, tmp_path / "f", SHA256, None, **QUICK)
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(tmp_path / "f"))
    assert len(server.asked) == 1


def test_a_disk_that_refuses_the_part_is_told_with_the_name_of_the_file(tmp_path):
    (tmp_path / ".f.part").mkdir()
    with Server() as server, pytest.raises(IsADirectoryError) as caught:
        download(server.url, tmp_path / "f", SHA256, None, **QUICK)
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
def test_a_length_that_is_no_number_tells_nothing(length, tmp_path):
    with Server(length=length) as server:
        assert download(server.url, tmp_path / "f", SHA256, None, **QUICK).read_bytes() == CONTENT


@pytest.mark.parametrize("length", [True, False, "9" * 5000])
def test_a_file_larger_than_wanted_is_refused_and_leaves_nothing(length, tmp_path):
    with Server(length=length) as server, pytest.raises(UserError, match=r"the file has .* GB or more"):
        download(server.url, tmp_path / "f", None, None, **QUICK, most_bytes=len(CONTENT) - 1)
    assert names(tmp_path) == []


@pytest.mark.parametrize("place", ["ftp://here/f", "file:///etc/hostname", "data:,f", "http://[::1"])
def test_no_redirection_leads_away_from_http(place, tmp_path):
    with Server(sends_to=place) as server, pytest.raises(UserError, match=r"not allowed|expected http|Invalid"):
        download(server.url, tmp_path / "f", None, None, **QUICK)
    assert "f" not in names(tmp_path)


def test_a_redirection_on_http_is_followed(tmp_path):
    with Server() as server, Server(sends_to=server.url) as first:
        assert download(first.url, tmp_path / "f", SHA256, None, **QUICK).read_bytes() == CONTENT
