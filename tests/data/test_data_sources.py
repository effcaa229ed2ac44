"""Where recordings are, downloads from a server in trouble, and synthetic recordings, in which
nobody overlaps.
"""

from __future__ import annotations

import errno
import sys
from pathlib import Path

import polars as pl
import pytest
from reference.file_server import CONTENT, SHA256, Server
from reference.refusals import user_error

from ganlane.data import (
    SyntheticTraffic,
    byte_progress,
    default_scenes,
    scene_lane_counts,
    synthetic_scenes,
    tracks_of_frame,
)
from ganlane.data.download import download
from ganlane.data.lanes import find_lane_changes
from ganlane.data.schema import validate
from ganlane.data.sources import data_folder
from ganlane.data.statistics import leader_gaps

QUICK = {"timeout_s": 5.0, "attempts": 3, "wait_s": 0.01}


def fetch(server, path, sha256=None, **settings):
    return download(server.url, path, sha256, **QUICK, **settings)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_file_arrives_whole_with_progress(tmp_path):
    # Bytes done and in total, at each piece.
    steps = []
    with Server() as server:
        path = download(
            server.url,
            tmp_path / "new" / "f",
            SHA256,
            lambda *step: steps.append(step),
            **QUICK,
        )
    assert path.read_bytes() == CONTENT
    assert names(path.parent) == ["f"]
    assert steps[-1] == (len(CONTENT), len(CONTENT))
    assert [done for done, _ in steps] == sorted(done for done, _ in steps)


@pytest.mark.parametrize(
    ("server", "ranges"),
    [
        (
            {"breaks": [300_000, 500_000]},
            [None, "bytes=300000-", "bytes=800000-"],
        ),
        (
            {"breaks": [300_000], "ranges": False},
            [None, "bytes=300000-"],
        ),
        ({"breaks": [300_000], "etag": None}, [None, None]),
        *(({"length": length}, [None]) for length in ("abc", "-5", "", "1e3")),
    ],
    ids=[
        "resumed",
        "server ignores Range",
        "no version",
        *(["invalid length"] * 4),
    ],
)
def test_a_broken_transfer_resumes_only_where_server_and_version_allow(server, ranges, tmp_path):
    with Server(**server) as running:
        assert fetch(running, tmp_path / "f", SHA256).read_bytes() == CONTENT
    assert running.asked == ranges


def test_a_later_run_resumes_what_an_earlier_one_left(
    tmp_path,
):
    with Server(breaks=[400_000, 0, 0, 0]) as server:
        with user_error(r"cannot be fetched, 400000 bytes came .*continues from there"):
            fetch(server, tmp_path / "f", SHA256)
        assert "f" not in names(tmp_path)
        # The next run finds the server well.
        server.breaks = []
        fetch(server, tmp_path / "f", SHA256)
    assert server.asked[-1] == "bytes=400000-"
    assert (tmp_path / "f").read_bytes() == CONTENT
    assert names(tmp_path) == ["f"]


@pytest.mark.parametrize(
    ("content", "etag"),
    [(CONTENT[::-1], '"two"'), (CONTENT[:1000], None)],
)
def test_a_part_of_another_version_or_longer_than_the_file_is_discarded(content, etag, tmp_path):
    with Server(breaks=[300_000, 0, 0, 0]) as server:
        with user_error("cannot be fetched"):
            fetch(server, tmp_path / "f")
        # The file changes on the server between two runs.
        server.content, server.etag, server.breaks = (
            content,
            etag or server.etag,
            [],
        )
        assert fetch(server, tmp_path / "f").read_bytes() == content
    assert names(tmp_path) == ["f"]


def test_a_corrupt_transfer_leaves_nothing(tmp_path):
    with (
        Server(content=CONTENT[:-1] + b"?") as server,
        user_error(f"its SHA-256 is .*{SHA256}"),
    ):
        fetch(server, tmp_path / "f", SHA256.upper())
    assert names(tmp_path) == []


def test_a_file_that_is_there_is_kept_and_compared(
    tmp_path,
):
    path = tmp_path / "f"
    path.write_bytes(CONTENT)
    with Server() as server:
        assert fetch(server, path, SHA256) == path
        assert server.asked == []
        with user_error(r"remove it, or correct data\.sha256"):
            fetch(server, path, "0" * 64)
    assert path.read_bytes() == CONTENT


def test_a_refused_request_is_reported_at_once(tmp_path):
    # Asking again would not help.
    with Server(status=404) as server:
        with user_error(r"the server says 404 Not Found; check data.url"):
            fetch(server, tmp_path / "f")
        assert len(server.asked) == 1
    with user_error("not an address"):
        download("file:///etc/hostname", tmp_path / "f")
    assert names(tmp_path) == []


def test_a_failing_server_is_tried_again_and_an_absent_one_is_named(
    tmp_path,
):
    with Server(status=503) as server:
        with user_error(r"0 bytes came \(503"):
            fetch(server, tmp_path / "f")
        assert len(server.asked) == QUICK["attempts"]
    with user_error(r"0 bytes came \(.*refused"):
        fetch(server, tmp_path / "f")


@pytest.mark.parametrize(
    ("spoil", "number"),
    [
        pytest.param(
            lambda part: part.symlink_to("/dev/full"),
            errno.ENOSPC,
            marks=pytest.mark.skipif(
                not Path("/dev/full").exists(),
                reason="there is no /dev/full",
            ),
        ),
        (Path.mkdir, errno.EISDIR),
    ],
)
def test_an_error_of_the_disk_is_reported_at_once_and_not_as_a_network_error(
    spoil, number, tmp_path
):
    # The incomplete file cannot be written.
    spoil(tmp_path / ".f.part")
    with (
        Server() as server,
        pytest.raises(OSError) as caught,  # noqa: PT011
    ):
        fetch(server, tmp_path / "f", SHA256)
    assert (caught.value.errno, caught.value.filename) == (
        number,
        str(tmp_path / "f"),
    )
    assert len(server.asked) == 1


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_shows_bytes_on_a_terminal_and_nothing_of_short_work_elsewhere(
    terminal, capsys, monkeypatch
):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    with byte_progress("read") as show:
        show(2_000_000, 4_000_000)
    err = capsys.readouterr().err
    assert ("read:  50%" in err and "2.00M/4.00M" in err) if terminal else err == ""


def test_the_recordings_are_found_through_the_variable(tmp_path, monkeypatch):
    monkeypatch.setenv("GANLANE_DATA", str(tmp_path))
    assert data_folder() == tmp_path
    with user_error(r"set GANLANE_DATA to a folder that holds ngsim/us101_scenes\.csv"):
        default_scenes()
    # First nothing, then a file, then no folder.
    (tmp_path / "ngsim").mkdir()
    deep = tmp_path / "ngsim" / "us101_scenes.csv"
    deep.write_text("scene,vehicle")
    assert default_scenes() == deep
    monkeypatch.setenv("GANLANE_DATA", str(tmp_path / "nowhere"))
    with user_error("no such folder"):
        data_folder()


def test_the_recordings_are_found_beside_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.delenv("GANLANE_DATA", raising=False)
    module = sys.modules["ganlane.data.sources"]
    # As if the package were installed elsewhere.
    monkeypatch.setattr(
        module,
        "__file__",
        str(tmp_path / "site" / "ganlane" / "data" / "sources.py"),
    )
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    assert data_folder() is None
    (tmp_path / "shared" / "data").mkdir(parents=True)
    assert data_folder() == tmp_path / "shared" / "data"


@pytest.mark.parametrize("length", [True, False, "9" * 5000])
def test_a_file_larger_than_wanted_is_refused_and_leaves_nothing(length, tmp_path):
    with (
        Server(length=length) as server,
        user_error(r"the file has .* GB or more"),
    ):
        fetch(
            server,
            tmp_path / "f",
            most_bytes=len(CONTENT) - 1,
        )
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    "place",
    [
        "ftp://here/f",
        "file:///etc/hostname",
        "data:,f",
        "http://[::1",
    ],
)
def test_no_redirection_leads_away_from_http(place, tmp_path):
    with (
        Server(sends_to=place) as server,
        user_error(r"not allowed|expected http|Invalid"),
    ):
        fetch(server, tmp_path / "f")
    assert "f" not in names(tmp_path)


def test_a_redirection_on_http_is_followed(tmp_path):
    with (
        Server() as server,
        Server(sends_to=server.url) as first,
    ):
        assert fetch(first, tmp_path / "f", SHA256).read_bytes() == CONTENT


def test_a_seed_makes_one_recording_and_another_seed_another():
    assert synthetic_scenes(seed=1).equals(synthetic_scenes(seed=1))
    assert not synthetic_scenes(seed=1).equals(synthetic_scenes(seed=2))
    # Scenes of one seed differ, too.
    one, other = synthetic_scenes(seed=1).partition_by("scene", include_key=False)
    assert not one.equals(other)


@pytest.mark.parametrize("lanes", [1, 2, 5])
def test_it_fits_the_schema_and_uses_every_lane(lanes):
    frame = synthetic_scenes(SyntheticTraffic(lanes=lanes))
    assert validate(frame, "made").equals(frame)
    assert set(scene_lane_counts(frame).values()) == {lanes}


@pytest.mark.parametrize("seed", range(5))
def test_nobody_comes_near_another_along_the_road(seed):
    # All put into one lane, the smallest gap is still that between slots less the sway of both.
    one_lane = synthetic_scenes(seed=seed).with_columns(lane=pl.lit(0, pl.Int64))
    assert leader_gaps(one_lane)["gap"].min() > 2.0


def test_the_share_of_changing_vehicles_is_found_by_the_detector():
    for changing, wander_m in (
        (40, 0.0),
        (0, SyntheticTraffic.wander_m),
    ):
        traffic = SyntheticTraffic(
            scenes=1,
            vehicles=40,
            changing_share=changing / 40,
            wander_m=wander_m,
        )
        tracks = tracks_of_frame(synthetic_scenes(traffic), {"synthetic-0": 3.5})
        assert len(find_lane_changes(tracks)) == changing
