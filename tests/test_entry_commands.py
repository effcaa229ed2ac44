"""The console script: dispatch, help, and a few whole commands in a process of their own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from ganlane.__main__ import COMMANDS, main
from ganlane.config.help import help_text
from ganlane.files import conf_folder

ROOT = Path(__file__).resolve().parents[1]


def command(*arguments, cwd):
    """A command as a user starts it, from a folder that is not the checkout."""
    environment = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PATH": "/usr/bin:/bin", "HOME": str(cwd)}
    line = [sys.executable, *arguments]
    return subprocess.run(line, cwd=cwd, capture_output=True, text=True, timeout=120, env=environment)


@pytest.fixture
def empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", COMMANDS)
def test_help_fits_on_a_page_and_the_rest_is_behind_a_flag(name, capsys):
    assert main([name, "--help"]) == 0
    short = capsys.readouterr().out
    assert short.count("\n") < 80
    assert all(part in short for part in (f"ganlane {name} ", "seed: 0", "exit status"))
    assert f"ganlane {name} --help-all" in short
    assert main([name, "--help-all"]) == 0
    assert capsys.readouterr().out == help_text(name) + "\n"


def test_help_of_train_explains_every_traffic_and_start():
    text = help_text("train")
    for group in ("traffic", "init", "experiment", "agent", "observation", "reward", "collector", "logger", "env"):
        for path in (conf_folder() / group).glob("*.yaml"):
            assert path.stem in text, f"{group}={path.stem}"


def test_usage_lists_every_command(capsys):
    assert main([]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_cfg_shows_the_config_and_leaves_nothing_behind(name, empty_folder, capsys):
    assert main([name, "--cfg", "job", "--resolve"]) == 0
    shown = capsys.readouterr()
    assert "seed: 0" in shown.out
    assert shown.err == ""
    assert list(empty_folder.iterdir()) == []


def test_cfg_shows_the_chosen_options_and_values(empty_folder, capsys):
    assert main(["train", "--cfg", "job", "env=dense", "env.lanes=5"]) == 0
    assert {"  vehicles: 30", "  lanes: 5"} <= set(capsys.readouterr().out.splitlines())
    assert main(["render", "--cfg", "job", "agent=keep_lane"]) == 0
    assert "driver: keep_lane" in capsys.readouterr().out.splitlines()


def test_cfg_of_an_unknown_key_ends_with_status_2(empty_folder, capsys):
    assert main(["train", "--cfg", "job", "no_such_key=1"]) == 2
    assert "no_such_key: no such key" in capsys.readouterr().err


@pytest.mark.parametrize("flags", [["--cfg", "job", "--resolve"], ["--info"]], ids=" ".join)
def test_hydras_views_of_the_config_work_in_a_fresh_process(flags, tmp_path):
    """There nothing has filled the ConfigStore before."""
    done = command("-m", "ganlane.train", *flags, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "seed: 0" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_help_does_not_wait_for_torch(tmp_path):
    program = (
        "import sys; from ganlane.__main__ import main; main(['train', '--help']); print('torch' in sys.modules)"
    )
    assert command("-c", program, cwd=tmp_path).stdout.splitlines()[-1] == "False"


@pytest.mark.slow
def test_a_whole_command_names_its_results(tmp_path):
    tiny = ["agents=[keep_lane]", "traffics=[idm]", "episodes=1", "env.goal_m=20"]
    done = command("-m", "ganlane", "evaluate", *tiny, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1].startswith(f"results: {tmp_path}")


def test_a_mistake_ends_the_process_with_status_2(tmp_path):
    done = command("-m", "ganlane", "train", "env.lanes=0", cwd=tmp_path)
    assert done.returncode == 2
    assert (
        done.stderr == "ganlane train: env.lanes=0: expected a number from 1 to 20; give for instance env.lanes=3.\n"
    )
    assert list(tmp_path.iterdir()) == []
