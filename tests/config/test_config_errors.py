"""A wrong value or flag, or a disk that refuses, gives one sentence, and leaves nothing
half-written behind.

A wrong value is reported without waiting for torch.
"""

import errno
import os
import signal
from operator import attrgetter
from unittest.mock import Mock, patch

import pytest
from reference.processes import ROOT, run
from reference.refusals import refusal, user_error

from ganlane.__main__ import main
from ganlane.config.compose import parsed
from ganlane.config.run import Stopped, run_command, settings
from ganlane.errors import is_users_matter
from ganlane.files import write_bytes
from ganlane.settings.record import make
from ganlane.settings.traffic import TrafficConfig


@pytest.mark.parametrize(
    ("stop", "number"),
    [(KeyboardInterrupt(), signal.SIGINT), (Stopped(signal.SIGTERM), signal.SIGTERM)],
    ids=["SIGINT", "SIGTERM"],
)
def test_a_signal_while_the_configuration_is_composed_is_no_error(
    stop, number, empty_folder, capsys
):
    with patch("ganlane.config.run.composed", side_effect=stop):
        assert main(["train", "traffic=idm"]) == 128 + number
    assert capsys.readouterr().err in ("", "ganlane train: stopped by Ctrl-C.\n")
    assert list(empty_folder.iterdir()) == []


def loaded(program: str, *names: str) -> str:
    """Which of the modules ``names`` a program has loaded in the end, and what else it prints."""
    program = f"import sys; {program}; print([name for name in {names} if name in sys.modules])"
    return run("-c", program).stdout


def test_parameters_are_declared_without_torch():
    names = sorted(path.stem for path in (ROOT / "ganlane" / "settings").glob("*.py"))[1:]
    program = (
        f"import importlib; [importlib.import_module('ganlane.settings.' + n) for n in {names}]"
    )
    assert loaded(program, "torch", "hydra", "omegaconf", "ganlane.sim") == "[]\n"


@pytest.mark.parametrize("line", ["train --help", "train env.lane=3"])
def test_help_and_mistakes_do_not_wait_for_torch_and_gymnasium(line):
    """Which take seconds to load.

    Whoever imports the package has its environments at once.
    """
    main = f"from ganlane.__main__ import main; main({line.split()})"
    told = loaded(f"sys.argv[0] = '-m'; {main}", "torch", "ganlane.sim", "gymnasium")
    assert told.splitlines()[-1] == "[]"


def test_the_package_brings_its_environments_without_torch():
    assert loaded("import ganlane", "torch", "gymnasium") == "['gymnasium']\n"


def test_a_command_that_there_is_not(capsys):
    assert main(["fly"]) == 2
    assert capsys.readouterr().err.startswith(
        "ganlane: fly: no such command; choose one of benchmark, evaluate"
    )


@pytest.mark.parametrize("line", ["\x1b[31mfly", "evaluate agents=[mobil,'\x1b[31mred']"])
def test_an_escape_sequence_reaches_no_terminal(line, empty_folder, capsys):
    assert main(line.split()) == 2
    told = capsys.readouterr().err
    assert r"\x1b[31m" in told
    assert "\x1b" not in told


@pytest.mark.parametrize("override", ["seed=" + "9" * 6000, "agents=" + "[" * 500 + "]" * 500])
def test_a_number_too_long_or_a_list_too_deep_for_python_is_one_sentence(override):
    with user_error(r"too long a number or too deep a list") as caught:
        parsed("evaluate", [override])
    assert len(str(caught.value)) < 200


def test_a_whole_number_that_no_float_can_hold_is_one_sentence():
    with user_error(r"expected a number of fewer digits"):
        settings("train", [f"env.goal_m=1{'0' * 400}"])


# --- a disk that refuses


def run_task(task, *arguments):
    """``ganlane evaluate`` with this function in place of the command's."""
    with patch("ganlane.config.run.function_of", lambda command: task):
        return run_command("evaluate", arguments)


def refused(capsys, task, *arguments):
    """The sentence with which ``ganlane evaluate`` ends when its task is this one."""
    with patch("ganlane.config.run.function_of", lambda command: task):
        return refusal(capsys, "evaluate", *arguments)


def test_a_refusal_while_a_command_writes(empty_folder, capsys):
    def task(config, folder):
        write_bytes(folder / "first.txt", b"whole")
        second = folder / "second.txt"
        with second.open("w") as file:
            file.write("half")
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(second))

    assert "second.txt: Read-only file system; check the path" in refused(capsys, task)


@pytest.mark.parametrize("kind", [OSError, RuntimeError])
def test_a_library_that_gives_the_number_in_its_text_alone(kind, empty_folder, capsys):
    """So does polars."""
    error = kind("underlying IO error: No space left on device (os error 28)")
    told = refused(capsys, Mock(side_effect=error))
    assert "a file or standard output: No space left on device; check the path" in told


def test_what_was_earned_before_the_disk_was_full_stays(empty_folder, capsys):
    def task(config, folder):
        write_bytes(folder / "agent.safetensors", b"trained for hours")
        raise OSError(errno.ENOSPC, "No space left on device")

    assert run_task(task, "hydra.run.dir=run") == 2
    assert capsys.readouterr().err == (
        "ganlane evaluate: a file or standard output: No space left on device; "
        "check the path, its permissions and the space there.\n"
    )
    assert (empty_folder / "run" / "agent.safetensors").read_bytes() == b"trained for hours"


def test_a_run_folder_below_a_file(empty_folder, capsys):
    (empty_folder / "file").write_text("no folder")
    err = refused(capsys, Mock(), "hydra.run.dir=file/run")
    assert "file/run: Not a directory; check the path" in err


def test_what_no_user_can_mend_keeps_its_traceback(empty_folder):
    refused_connection = ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused")
    with pytest.raises(ConnectionRefusedError):
        run_task(Mock(side_effect=refused_connection))
    assert list(empty_folder.rglob("*")) == []
    assert not is_users_matter(OSError("libfile.so: undefined symbol"))
    assert not is_users_matter(ValueError(errno.ENOSPC))


# --- words as they are meant


@pytest.mark.parametrize(
    ("line", "key", "value"),
    [
        ("evaluate agents=mobil", "agents", ["mobil"]),
        ("render agent=mobil", "agents", ["mobil"]),
        ("train total_decisions=1.5e6", "total_decisions", 1_500_000),
        ("train seed=1 seed=2", "seed", 2),
        (
            "train pretrain.traffic=gan pretrain.traffic.guard=false",
            "pretrain.traffic.guard",
            False,
        ),
        ("train traffic@evaluation.traffic=idm", "evaluation.traffic.option", "idm"),
        ("train experiment=paper pretrain.traffic=idm", "pretrain.traffic.option", "idm"),
        (
            "train traffic=idm traffic._target_=a.B traffic.pace=2",
            "traffic.arguments_",
            {"pace": 2},
        ),
        ("evaluate traffics=[a.B]", "traffics", {"a.B": make(TrafficConfig, "a.B")}),
        (
            "evaluate traffics={calm:{name:gan,noise_scale:0.5}}",
            "traffics",
            {"calm": make(TrafficConfig, {"name": "gan", "noise_scale": 0.5})},
        ),
    ],
)
def test_a_word_sets_what_it_says(line, key, value):
    command, *words = line.split()
    assert attrgetter(key)(settings(command, words)) == value
