"""``ganlane prepare`` from end to end, on recordings made up, in process.

And on to a generator that drives.
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import polars as pl
import pytest
from PIL import Image
from reference.file_server import SHA256, Server
from reference.recordings import (
    ngsim_rows,
    portal_csv,
    traffic,
)
from reference.refusals import last_path

from ganlane.config.run import run_command
from ganlane.data import (
    SyntheticTraffic,
    read_scenes,
    synthetic_scenes,
    write_scene_csv,
)

main = partial(run_command, "prepare")


@pytest.fixture(autouse=True)
def here(empty_folder, monkeypatch):
    monkeypatch.delenv("GANLANE_DATA", raising=False)
    return empty_folder


def results(out: str) -> dict:
    path = last_path(out)
    assert Image.open(path.with_name("report.png")).size == (
        1440,
        588,
    )
    assert path.with_name("report.md").read_text().startswith("# Recordings: ")
    return json.loads(path.read_text())


def write_csv(path: Path, **more) -> Path:
    write_scene_csv(synthetic_scenes(SyntheticTraffic(**more)), path)
    return path


def test_a_scene_csv_becomes_parquet_and_figures(here, capsys):
    write_csv(here / "mine.csv", seconds=8.0)
    assert main(["data.path=mine.csv", "out=mine"]) == 0
    numbers = results(capsys.readouterr().out)
    assert numbers["rows"] == {
        "read": 1920,
        "kept": 1920,
        "dropped": {},
        "written": 1920,
    }
    assert numbers["acceleration_raw"]["count"] > numbers["acceleration_smoothed"]["count"] > 0
    names = {
        "speed",
        "headway",
        "time_headway",
        "gap",
        "lane_changes",
        "wall_s",
        "code",
    }
    assert names <= numbers.keys()
    assert read_scenes("mine").equals(read_scenes("mine.csv"))


def test_download_then_prepare(here, capsys):
    content = portal_csv(ngsim_rows(traffic().filter(pl.col("scene") == "synthetic-0"))).encode()
    # The connection breaks once.
    with Server(content=content, breaks=[20_000]) as server:
        fetched = [
            "data=ngsim",
            "data.path=ngsim.csv",
            "data.download=true",
            f"data.url={server.url}",
        ]
        assert (
            main(
                [
                    *fetched,
                    f"data.sha256={SHA256}",
                    "data.path=other.csv",
                ]
            )
            == 2
        )
        assert "its SHA-256 is" in capsys.readouterr().err
        assert list(here.iterdir()) == []
        assert main(fetched) == 0
    assert results(capsys.readouterr().out)["rows"]["kept"] == 540
    assert (here / "ngsim.csv").read_bytes() == content
