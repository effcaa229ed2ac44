"""A run's folder has one run at a time.

What a run has earned can be gone on with, however it ended.
"""

import csv
import errno
import os
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import pytest
import torch
from hydra.core.override_parser.types import Quote, QuotedString
from reference.marks import slow
from reference.processes import run, start
from reference.refusals import user_error
from training.small_runs import agent, road, train
from training.small_runs import settings as schedule

from ganlane.config.compose import parsed
from ganlane.config.run import (
    CONFIG,
    LOCK,
    as_yaml,
    held,
    newest_unfinished,
    run_command,
    settings,
    single_runs,
)
from ganlane.errors import UserError
from ganlane.training.checkpoint import LAST, load_checkpoint

pytestmark = pytest.mark.usefixtures("empty_folder")
#: The folder of a run.
RUN = Path("run")
COLUMNS = ("decisions", "updates", "mean_return", "loss", "out_of_road_rate")


def short_run(config, folder):
    """A training run of seconds in the folder of a ``ganlane train``, with evaluations."""
    learner = agent()
    figures = {"mean_reward": 0.0}

    def evaluate(policy):
        figures["mean_reward"] += 1.0
        return dict(figures)

    resume = folder / LAST if config.resume else None
    often = schedule(160, log_every=40, evaluate_every=80, checkpoint_every_s=0.0)
    train(road(), learner, often, folder, evaluate, resume=resume)


def command(*arguments, task=short_run):
    with patch("ganlane.config.run.function_of", lambda command: task):
        return run_command("train", [*arguments, "seed=3"])


def left_by(folder):
    """Weights and figures of a run, without times."""
    state = load_checkpoint(folder / LAST)
    rows = [[row[c] for c in COLUMNS] for row in csv.DictReader((folder / "metrics.csv").open())]
    evaluated = [row["decisions"] for row in csv.DictReader((folder / "evaluation.csv").open())]
    return state["agent"]["network"], rows, evaluated


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "run"
    assert command(f"hydra.run.dir={folder}") == 0
    return left_by(folder)


def same(ours, theirs):
    (weights, *rest), (whole, *others) = ours, theirs
    return rest == others and all(torch.equal(weights[name], whole[name]) for name in whole)


class Disk:
    """Room for so many writes that are synced; then none until there is ``room`` again."""

    def __init__(self, writes: int) -> None:
        self.left, self.fsync = writes, os.fsync

    def __call__(self, handle: int) -> None:
        self.left -= 1
        if self.left < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        self.fsync(handle)


@pytest.mark.parametrize("writes", [3, 7, 10, *map(slow, (2, 4, 5, 6, 8, 9, 11))])
def test_a_run_ended_by_a_full_disk_goes_on_to_the_same_weights(
    writes, undisturbed, monkeypatch, capsys
):
    with monkeypatch.context() as patch:
        patch.setattr("ganlane.files.os.fsync", Disk(writes))
        patch.setattr("ganlane.training.checkpoint.PATIENCE", 0.0)
        assert command("hydra.run.dir=run") == 2
    assert "No space left on device; check the path" in capsys.readouterr().err
    assert not list(Path().rglob("*.part"))
    assert (RUN / LAST).is_file() == (RUN / CONFIG).is_file() == RUN.exists()
    assert command("resume=run" if RUN.exists() else "hydra.run.dir=run") == 0
    assert same(left_by(RUN), undisturbed)


def test_a_run_that_ends_in_an_error_after_training_keeps_its_command_line(capsys):
    def task(config, folder):
        short_run(config, folder)
        raise UserError("a worker died")

    assert command("hydra.run.dir=run", "env.lanes=4", task=task) == 2
    assert "lanes: 4" in (RUN / CONFIG).read_text()
    assert command("resume=run", "log_every=50", task=task) == 2
    assert "log_every: 50" in (RUN / CONFIG).read_text()
    assert command("resume=run") == 0


def test_a_second_run_in_a_folder_is_refused_while_the_first_is_at_work(capsys):
    def second(config, folder):
        before = sorted(Path().rglob("*"))
        assert command("hydra.run.dir=run") == 2
        assert f"run: a run is at work there (process {os.getpid()} on " in capsys.readouterr().err
        assert sorted(Path().rglob("*")) == before

    assert command("hydra.run.dir=run", task=second) == 0
    assert not (RUN / LOCK).exists()
    assert command("hydra.run.dir=run") == 0


def test_the_lock_of_a_killed_run_stops_nobody_and_its_half_written_files_go():
    script = (
        "import time; from pathlib import Path; from ganlane.config.run import held\n"
        "from ganlane.files import atomic_path\n"
        "with held(Path('run')), atomic_path('run/checkpoints/last.pt') as part:\n"
        "    part.write_bytes(b'half'); print('at work', flush=True); time.sleep(60)"
    )
    with start("-c", script) as process:
        assert process.stdout.readline() == "at work\n"
        with user_error(rf"process {process.pid} on .*; wait for its end"), held(RUN):
            pass
        process.kill()
    assert (RUN / LOCK).is_file()
    assert len(list(Path().rglob("*.part"))) == 1
    (RUN / ".a.film.part").write_text("of another program")
    with held(RUN):
        assert [path.name for path in Path().rglob("*.part")] == [".a.film.part"]
    assert not (RUN / LOCK).exists()


# --- the settings of a resumed run


def make_run(folder, words=(), age_s=0, finished=False):
    """A run's folder as far as resuming looks at it."""
    (folder / "checkpoints").mkdir(parents=True)
    (folder / CONFIG).write_text(as_yaml(settings("train", list(words))))
    checkpoint = folder / "checkpoints" / "last.pt"
    checkpoint.touch()
    os.utime(checkpoint, (1_000_000 - age_s, 1_000_000 - age_s))
    if finished:
        (folder / "results.json").touch()


def test_a_resumed_run_keeps_its_settings_but_for_those_on_the_command_line():
    make_run(RUN, ["traffic=idm", "seed=3", "env.lanes=4", "agent.gamma=0.5"])
    config = settings("train", ["resume=run", "seed=4", "agent.gamma=0.6", "env.vehicles=5"])
    assert (config.traffic.label(), config.seed, config.resume) == ("idm", 4, "run")
    assert (config.env.lanes, config.env.vehicles, config.agent.gamma) == (4, 5, 0.6)
    assert settings("train", ["resume=run", "traffic=gan"]).traffic.label() == "gan"


@pytest.mark.parametrize(
    "words",
    [
        ["experiment=general"],
        ["env=cut_in", "env.scene.gap_m=12"],
        ["experiment=paper", "traffic=idm_faults", "mask=safe"],
        ["traffic=idm", "traffic._target_=a.B", "traffic.pace=2"],
        ["observation.sensors.delay_s=1", "agent=dqn"],
    ],
    ids=" ".join,
)
def test_a_resumed_run_is_the_run_that_was_stopped(words):
    make_run(RUN, words)
    trusted = [word for word in words if "_target_" in word]
    resumed = settings("train", ["resume=run", *trusted])
    assert replace(resumed, resume=None) == settings("train", words)


def test_a_checkpoint_stands_for_its_run():
    make_run(RUN, ["seed=7"])
    make_run(RUN / "pretrain")
    (RUN / "pretrain" / CONFIG).unlink()
    for path in ("run/checkpoints/last.pt", "run/pretrain", "run/pretrain/checkpoints/last.pt"):
        config = settings("train", [f"resume={path}"])
        assert (config.resume, config.seed) == ("run", 7)


def test_auto_takes_the_newest_unfinished_run():
    runs = Path("outputs/train")
    make_run(runs / "old", age_s=100)
    make_run(runs / "new", age_s=50)
    make_run(runs / "done", finished=True)
    assert newest_unfinished(runs) == runs / "new"
    assert settings("train", ["resume=auto"]).resume == "outputs/train/new"


def test_auto_starts_afresh_without_an_unfinished_run(capsys):
    assert settings("train", ["resume=auto", "seed=1"]).resume is None
    assert "a new one is started" in capsys.readouterr().err


def test_a_sweep_is_every_combination():
    runs = single_runs(parsed("train", ["seed=0,1", "traffic=idm,gan", "threads=1"]))
    assert runs == [
        [f"seed={seed}", f"traffic={traffic}", "threads=1"]
        for seed in (0, 1)
        for traffic in ("idm", "gan")
    ]


@pytest.mark.parametrize("name", ["it's", "two words, [one]", "back\\"])
def test_a_folder_may_be_called_anything(name):
    make_run(Path(name), ["seed=3"])
    word = "resume=" + QuotedString(name, Quote.single).with_quotes()
    config = settings("train", [word])
    assert (config.seed, config.resume) == (3, name)


def test_a_folder_that_the_locale_cannot_name_is_a_folder_like_others(tmp_path):
    """Such a locale is that of many containers and cron jobs."""
    folder = tmp_path / "ü"
    folder.mkdir()
    words = ["agents=[mobil]", "traffics=[idm]", "episodes=2", "threads=1", "env.goal_m=40"]
    locale = {"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = run("-m", "ganlane", "evaluate", *words, cwd=folder, **locale)
    assert done.returncode == 0, done.stderr
    assert list(folder.rglob("episodes.parquet"))


def test_a_word_beyond_the_locale_is_refused_by_name():
    with user_error(r"characters that this locale does not know"):
        parsed("render", ["out=film_\udcc3\udcbc.gif"])
