"""What ``resume=`` makes of a command line."""

from __future__ import annotations

import os

import pytest

from ganlane.config.command_line import parse, quoted, single_runs, without_repetitions
from ganlane.config.runs import OVERRIDES, newest_unfinished, with_resumed
from ganlane.errors import UserError


def make_run(folder, overrides, age_s=0, finished=False):
    """A run's folder as far as resuming looks at it."""
    (folder / "checkpoints").mkdir(parents=True)
    (folder / OVERRIDES).write_text("".join(f"- {line}\n" for line in overrides) or "[]\n")
    checkpoint = folder / "checkpoints" / "last.pt"
    checkpoint.touch()
    os.utime(checkpoint, (1_000_000 - age_s, 1_000_000 - age_s))
    if finished:
        (folder / "results.json").touch()


def test_a_resumed_run_keeps_its_command_line_and_its_folder(tmp_path):
    run = tmp_path / "run"
    make_run(run, ["traffic=idm", "seed=3"])
    merged = with_resumed("train", [f"resume={run}", "seed=4"], multirun=False)
    assert merged == ["traffic=idm", "seed=4", f"resume='{run}'", f"hydra.run.dir='{run}'"]


def test_a_checkpoint_stands_for_its_run(tmp_path):
    run = tmp_path / "run"
    make_run(run, [])
    make_run(run / "pretrain", [])
    (run / "pretrain" / OVERRIDES).unlink()
    for path in (run / "checkpoints" / "last.pt", run / "pretrain", run / "pretrain" / "checkpoints" / "last.pt"):
        assert f"hydra.run.dir='{run}'" in with_resumed("train", [f"resume={path}"], multirun=False)


def test_auto_takes_the_newest_unfinished_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runs = tmp_path / "outputs" / "train"
    make_run(runs / "old", [], age_s=100)
    make_run(runs / "new", [], age_s=50)
    make_run(runs / "done", [], finished=True)
    assert newest_unfinished(runs) == runs / "new"
    assert "hydra.run.dir='outputs/train/new'" in with_resumed("train", ["resume=auto"], multirun=False)


def test_auto_starts_afresh_without_an_unfinished_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert with_resumed("train", ["resume=auto", "seed=1"], multirun=False) == ["resume=null", "seed=1"]


def test_a_folder_without_a_checkpoint_is_refused(tmp_path):
    with pytest.raises(UserError, match="no checkpoint there"):
        with_resumed("train", [f"resume={tmp_path}"], multirun=False)


def test_the_last_of_several_overrides_counts():
    assert without_repetitions(["traffic=idm", "seed=1", "traffic=gan"]) == ["traffic=gan", "seed=1"]


def test_a_sweep_is_every_combination():
    runs = single_runs(["seed=0,1", "traffic=idm,gan", "threads=1"], multirun=True)
    assert [sorted(run) for run in runs] == [
        sorted([f"seed={seed}", f"traffic={traffic}", "threads=1"]) for seed in (0, 1) for traffic in ("idm", "gan")
    ]


@pytest.mark.parametrize("name", ["it's", "a'b'", "two words, [one]", "back\\\\", "back\\\\'s"])
def test_a_folder_may_be_called_anything(name, tmp_path):
    run = tmp_path / name
    make_run(run, ["seed=3"])
    merged = with_resumed("train", [f"resume={quoted(run)}"], multirun=False)
    assert {override.key_or_group: override.value() for override in parse(merged)} == {
        "seed": 3,
        "resume": str(run),
        "hydra.run.dir": str(run),
    }
