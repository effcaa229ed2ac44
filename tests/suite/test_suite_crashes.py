"""Crashes are listed with their actions, and come back when they are driven again."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from reference.refusals import user_error

from ganlane.config.run import run_command
from ganlane.evaluation.rows import FAILURES
from ganlane.settings.record import plain
from ganlane.suite.crashes import Crash, CrashList, read_crashes

main = partial(run_command, "render")

SHIPPED = Path(__file__).parents[2] / "docs" / "reproduce" / "crashes.json"


@pytest.fixture(scope="module")
def shipped() -> CrashList:
    return read_crashes(SHIPPED)


def earliest(listed: CrashList) -> dict[str, Crash]:
    """The earliest crash on each traffic."""
    return {
        crash.traffic: crash
        for crash in sorted(listed.crashes, key=lambda crash: -len(crash.actions))
    }


def check_they_happen_again(listed: CrashList) -> None:
    assert listed.drive_again() == [crash.end for crash in listed.crashes]


@pytest.mark.parametrize("every", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_crashes_of_the_shipped_agents_happen_again(every, shipped):
    early = {
        traffic: crash for traffic, crash in earliest(shipped).items() if len(crash.actions) < 20
    }
    assert early.keys() >= {"idm_mobil", "idm_faults", "gan", "gan_calibrated"}
    check_they_happen_again(shipped if every else replace(shipped, crashes=list(early.values())))


def test_the_list_holds_failures_of_the_published_evaluation(shipped):
    failures = json.loads((SHIPPED.parent / "results.json").read_text())["failures"]
    published = {
        (row["driver"], row["traffic"], number, end)
        for row in failures
        for end in FAILURES
        for number in row[end]
    }
    for crash in shipped.crashes:
        assert (crash.driver, crash.traffic, crash.episode, crash.end) in published
    drivers = {crash.driver.partition("+")[0] for crash in shipped.crashes}
    assert drivers >= {f"agent_{recipe}@{seed}" for recipe in ("idm", "gan") for seed in range(4)}
    assert SHIPPED.stat().st_size < 200_000


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("traffics gan _target_", "os.getcwd"),
        ("traffics mixed", {"shares": {"os.getcwd": 1}}),
        ("crashes 0 actions", "0123"),
        ("crashes 0 episode", 1.5),
        ("env lanes", 0),
    ],
)
def test_a_list_with_a_wrong_value_is_refused_in_one_sentence(
    path,
    value,
    small_list,
):
    content = part = json.loads(small_list.read_text())
    *parents, last = path.split()
    for name in parents:
        part = part[int(name) if name.isdigit() else name]
    part[last] = value
    if last == "mixed":
        content["crashes"][0]["traffic"] = "mixed"
    small_list.write_text(json.dumps(content))
    with user_error("not a list of crashes") as refused:
        read_crashes(small_list)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[]",
        b"{}",
        b"\xff\xfe",
        b"[" * 100_000,
        b'{"kind": 3}',
    ],
)
def test_other_files_are_refused_in_one_sentence(content, tmp_path):
    (tmp_path / "crashes.json").write_bytes(content)
    with user_error("not a list of crashes") as refused:
        read_crashes(tmp_path / "crashes.json")
    assert "\n" not in str(refused.value)
    with user_error("cannot be read"):
        read_crashes(tmp_path / "nowhere.json")


@pytest.fixture
def small_list(
    shipped,
    tmp_path,
    monkeypatch,
) -> Path:
    """Two early crashes on traffic of two kinds."""
    monkeypatch.chdir(tmp_path)
    crashes = [earliest(shipped)[traffic] for traffic in ("idm_faults", "gan")]
    content = json.loads(SHIPPED.read_text())
    Path("crashes.json").write_text(json.dumps({**content, "crashes": plain(crashes)}))
    return Path("crashes.json")


def test_one_page_plays_crashes_of_several_traffics(small_list, capsys):
    crashes = read_crashes(small_list).crashes
    assert main([f"crashes={small_list}", "out=player.html"]) == 0
    out = capsys.readouterr().out
    assert "listed:" not in out  # each ended as listed
    page = Path("player.html").read_text()
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.S)[1])["episodes"]
    for shown, crash in zip(data, crashes, strict=True):
        assert (shown["agent"], shown["traffic"]) == (crash.driver, crash.traffic)
        assert (shown["seed"], shown["episode"]) == (crash.seed, crash.episode)
        assert shown["outcome"] == crash.end


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("crashes=nowhere.json", "nowhere.json: cannot be read"),
        ("crashes=crashes.json agents=[nobody]", "none of these agents"),
        ("crashes=crashes.json out=a.gif", "expected one of html, parquet"),
        ("crashes=crashes.json run=RUN", "leave one of them out"),
        ("traffics=[idm]", "goes with crashes=FILE"),
    ],
)
def test_a_mistake_is_one_sentence(
    line,
    message,
    small_list,
    capsys,
):
    assert main(line.split()) == 2
    assert message in capsys.readouterr().err
