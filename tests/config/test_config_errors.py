"""A wrong value or flag, or a disk that refuses, gives one sentence, and leaves nothing
half-written behind.

A wrong value is reported without waiting for torch.
"""

from __future__ import annotations

import errno
import os
import pickle
import signal
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig, ListConfig, Node, OmegaConf
from reference.hydra_memory import composed, own_part
from reference.refusals import everything_below, is_one_sentence, refusal

from ganlane.__main__ import COMMANDS, main
from ganlane.config.app import Stopped, run_command
from ganlane.config.command_line import as_meant, check, parse, refuse_unknown_keys, sentence
from ganlane.config.schemas import SCHEMAS
from ganlane.errors import ADVICE, UserError, is_users_matter
from ganlane.files import write_bytes

ROOT = Path(__file__).resolve().parents[2]
COMPOSED = {command: own_part(composed(command)) for command in COMMANDS}


def leaves(node: Any, prefix: str = "") -> list[tuple[str, Any]]:
    """(key, value) of everything that is not a mapping."""
    found = []
    for name in node:
        key, value = f"{prefix}{name}", OmegaConf.select(node, str(name))
        found += leaves(value, f"{key}.") if isinstance(value, DictConfig) else [(key, value)]
    return found


KEYS = [
    (command, key, value) for command, config in COMPOSED.items() for key, value in leaves(config)
]
LISTS = [(c, k) for c, k, v in KEYS if isinstance(v, ListConfig)]


@pytest.mark.parametrize(
    ("command", "given", "meant"),
    [
        ("render", "run=a", "run=['a']"),
        ("render", "run=a/b=c,d e", "run=['a/b=c','d e']"),
        ("render", "run=it's,b", "run=['it\\'s','b']"),
        ("render", "run=[a,b]", "run=[a,b]"),
        ("render", "run=null", "run=null"),
        ("render", "out=a,1e5", "out=a,1e5"),
        ("render", "episodes=0,1e1", "episodes=[0,10]"),
        ("evaluate", "agents=mobil", "agents=['mobil']"),
        ("train", "env.front_speed_mps=10,12.5", "env.front_speed_mps=[10,12.5]"),
        ("train", "evaluation.agents=mobil", "evaluation.agents=['mobil']"),
        ("train", "total_decisions=1.5e6", "total_decisions=1500000"),
        ("train", "total_decisions=1.5e0", "total_decisions=1.5e0"),
        ("train", "agent.capacity=1e5", "agent.capacity=100000"),
        ("train", "env.goal_m=1e3", "env.goal_m=1e3"),
    ],
)
def test_lists_need_no_brackets_and_whole_numbers_may_have_an_exponent(command, given, meant):
    assert as_meant(command, given) == meant


def test_in_a_sweep_a_comma_separates_runs():
    assert (
        as_meant("evaluate", "agents=mobil,agent_idm", multirun=True)
        == "agents=['mobil'],['agent_idm']"
    )
    assert as_meant("evaluate", "episodes=range(1,3)", multirun=True) == "episodes=range(1,3)"
    assert (
        as_meant("train", "total_decisions=1e3,2e3", multirun=True) == "total_decisions=1000,2000"
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_every_whole_number_may_have_an_exponent_and_every_list_may_lack_brackets(command):
    whole = [key for c, key, value in KEYS if c == command and type(value) is int]
    assert [key for key in whole if as_meant(command, f"{key}=2e1") != f"{key}=20"] == []
    lists = [
        key
        for key in (key for c, key in LISTS if c == command)
        if "[" not in as_meant(command, f"{key}=1")
    ]
    assert lists == []


@pytest.mark.parametrize("command", COMMANDS)
def test_a_key_that_there_is_passes_the_check_before_composing(command):
    refuse_unknown_keys(command, parse([f"{key}=1" for c, key, _ in KEYS if c == command]))


@pytest.mark.parametrize(
    "group", ["env", "collector", "init", "data", "generator", "agent", "traffic"]
)
def test_a_key_that_any_option_of_a_group_has_passes_it_too(group):
    command = {"data": "train_generator", "generator": "train_generator"}.get(group, "train")
    of_options = {each.name for kind in SCHEMAS[group].values() for each in fields(kind)}
    assert of_options
    refuse_unknown_keys(command, parse([f"{group}.{name}=1" for name in of_options]))


#: Flags without effect.
IDLE_FLAGS = {
    "--resolve": "--resolve: it goes with --cfg alone",
    "--package env": "--package: it goes with --cfg alone",
    "--info config --resolve": "--resolve: it goes with --cfg alone",
    "--config-dir .": "--config-dir: ganlane has its own configuration",
    "--config-name train": "--config-name: ganlane has its own configuration",
    "--cfg job --config-path .": "--config-path: ganlane has its own configuration",
}
#: Command line to a part of its sentence.
MISTAKES = {
    "train env.lane=3": "env.lane: no such key (did you mean 'lanes'?)",
    "train trafic=gan": "trafic: no such key (did you mean 'traffic'?); known are agent",
    "train agent.gama=0.9": "agent.gama: no such key (did you mean 'gamma'?); agent has adam_eps",
    "train collector.nm_envs=2": "collector.nm_envs: no such key (did you mean 'num_envs'?)",
    "train pretrain.traffic.guard=false": "pretrain.traffic.guard: a key below one that is null",
    "train traffic=ganny": "traffic=ganny: no such option (did you mean 'gan'?)",
    "train env=[a,b]": "choose one of blocked_lane",
    "train env.idm=3": "env.idm.NAME=VALUE",
    "train +env.wheels=3": "keys cannot be added",
    "train ++env.wheels=3": "keys cannot be added",
    "train ~env.lanes": "keys cannot be deleted",
    "train lanes": "not of the form key=value",
    "train --quick": "unrecognized arguments: --quick",
    "train seed=0,1": "add -m for a sweep",
    "train -m seed=0,-1": "seed=-1: expected a number from 0",
    "train -m seed=0,1 traffic=idm,ganny": "traffic=ganny: no such option",
    "train -m seed=0,1 resume=auto": "one run is resumed at a time",
    "train resume=nowhere": "resume=nowhere: no checkpoint there",
    "train env.vehicles=100": "env.vehicles=100 do not fit: 3 lanes x 9 vehicles",
    "train env.decision_period_s=0.15": "not a multiple of 0.1 s",
    "train env.front_speed_mps=[12,10]": "two numbers [low, high]",
    "train agent.warmup=5": "expected at least agent.batch_size=256",
    "train init=none init.path=mine": "use init=idm_ckpt init.path=mine",
    "train pretrain.total_decisions=10": "traffic@pretrain.traffic=idm_mobil",
    "train device=tpu": "device=tpu: expected one of cpu, cuda",
    "train traffic._target_=nonsense": "expected an import path",
    "train hydra.nonsense=1": "hydra.nonsense: no such key",
    "evaluate traffic=gan": "did you mean traffics=[NAME,NAME]?",
    "evaluate traffics=[gann]": "traffics=gann: no such traffic (did you mean 'gan'?)",
    "evaluate agents=[mobil,mobil]": "a list of different entries",
    "render format=avi": "format=avi: expected null or one of gif, mp4, png",
    "render film.start_s=9 film.end_s=3": "expected more than film.start_s=9",
    "render out=nowhere/film.gif": "out=nowhere/film.gif: expected a file in a folder that exists",
    "train_generator generator=gann": "choose one of calibrated, paper, social_gan",
    "train_generator folds=1": "one fold leaves nothing to fit to",
    "train env.lanes=many": "env.lanes=many: expected a whole number",
    "train agent.noisy=perhaps": "agent.noisy=perhaps: expected true or false",
    "evaluate agents={a:1}": "agents: expected a list in brackets",
    "train traffic=mixed traffic.shares=3": "names of traffics with whole numbers",
    **{f"evaluate {flags}": told for flags, told in IDLE_FLAGS.items()},
}


@pytest.mark.parametrize("line", MISTAKES)
def test_a_mistake_ends_in_one_sentence_and_leaves_nothing(line, empty_folder, capsys):
    assert MISTAKES[line] in refusal(capsys, *line.split())


@pytest.mark.parametrize(
    "stop", [KeyboardInterrupt(), Stopped(signal.SIGTERM)], ids=["SIGINT", "SIGTERM"]
)
def test_a_signal_while_the_configuration_is_composed_is_no_error(
    stop, empty_folder, monkeypatch, capsys
):

    def interrupted(self):
        raise stop

    # omegaconf cleans up after it, with an error of its own
    monkeypatch.setattr(Node, "_key", interrupted)
    assert main(["train", "traffic=idm"]) == 128 + getattr(stop, "number", signal.SIGINT)
    assert capsys.readouterr().err in ("", "ganlane train: stopped by Ctrl-C.\n")
    assert list(empty_folder.iterdir()) == []


def loaded(program: str, *names: str) -> str:
    """Which of the modules ``names`` a program has loaded in the end, and what else it prints."""
    program = f"import sys; {program}; print([name for name in {names} if name in sys.modules])"
    environment = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PATH": "/usr/bin:/bin"}
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        timeout=120,
        env=environment,
        check=True,
    )
    return done.stdout


def test_parameters_are_declared_without_torch():
    names = sorted(path.stem for path in (ROOT / "ganlane" / "parameters").glob("*.py"))[1:]
    program = f"import importlib; [importlib.import_module('ganlane.parameters.' + name) for name in {names}]"
    assert loaded(program, "torch", "hydra", "omegaconf", "ganlane.sim") == "[]\n"


@pytest.mark.parametrize(
    "line", ["train env.lane=3", "train env.lanes=0", "evaluate traffics=[gann]"]
)
def test_a_mistake_is_reported_without_torch(line):
    """Which takes seconds to load."""
    assert (
        loaded(f"from ganlane.__main__ import main; main({line.split()})", "torch", "ganlane.sim")
        == "[]\n"
    )


@pytest.mark.parametrize("started", ["-m", "/bin/ganlane"])
def test_a_mistake_is_reported_without_gymnasium(started):
    """Whose import would take a third of the time.

    Whoever imports the package has its environments at once.
    """
    mistake = "from ganlane.__main__ import main; main(['train', 'env.lane=3'])"
    assert loaded(f"sys.argv[0] = {started!r}; {mistake}", "gymnasium") == "[]\n"
    assert loaded("import ganlane", "gymnasium") == "['gymnasium']\n"


class Trap:
    """Writes a file when it is unpickled."""

    def __reduce__(self):
        return (open, ("sprung", "w"))


def test_a_pickled_run_is_not_opened(empty_folder, capsys):
    (empty_folder / "run.pkl").write_bytes(pickle.dumps(Trap()))
    err = refusal(capsys, "evaluate", "--cfg", "job", "--experimental-rerun", "run.pkl")
    assert "--experimental-rerun: ganlane has its own configuration" in err


def test_a_command_that_there_is_not(capsys):
    assert main(["fly"]) == 2
    assert capsys.readouterr().err.startswith(
        "ganlane: fly: no such command; choose one of train, evaluate"
    )


def test_resolve_and_package_go_with_cfg(capsys):
    assert main(["evaluate", "--cfg", "job", "--resolve", "--package", "env"]) == 0
    assert "lanes: 3" in capsys.readouterr().out


@pytest.mark.parametrize("override", ["seed=" + "9" * 6000, "agents=" + "[" * 500 + "]" * 500])
def test_a_number_too_long_or_a_list_too_deep_for_python_is_one_sentence(override):
    with pytest.raises(UserError, match=r"too long a number or too deep a list") as caught:
        parse([override])
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("key", ["env.goal_m", "checkpoint_every_s", "env.idm.headway_s"])
def test_a_whole_number_that_no_float_can_hold_is_one_sentence(key):
    with pytest.raises(UserError, match=r"too large; give a number of fewer digits"):
        check("train", [f"{key}=1{'0' * 400}"])


@pytest.mark.parametrize("key", ["total_decisions", "env.vehicles", "agent.capacity"])
def test_a_whole_number_of_more_than_64_bits_is_out_of_range(key):
    with pytest.raises(UserError, match=key):
        check("train", [f"{key}={2**63}"])


# --- a disk that refuses


def refused(capsys, task, *arguments):
    """The sentence with which ``ganlane evaluate`` ends when its task is this one.

    Nothing new is left.
    """
    before = everything_below(Path.cwd())
    assert run_command("evaluate", arguments, task) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert is_one_sentence(err, "evaluate")
    assert everything_below(Path.cwd()) == before
    return err


@pytest.mark.parametrize(
    ("number", "told"),
    [
        (errno.ENOSPC, "No space left on device; make room there"),
        (errno.EROFS, "Read-only file system; check the permissions"),
    ],
)
def test_a_refusal_while_a_command_writes(number, told, empty_folder, capsys):
    def task(config, folder):
        write_bytes(folder / "first.txt", b"whole")
        with (folder / "second.txt").open("w") as file:
            file.write("half")
            raise OSError(number, os.strerror(number), str(folder / "second.txt"))

    err = refused(capsys, task)
    assert f"second.txt: {told}" in err


@pytest.mark.parametrize("kind", [OSError, RuntimeError])
def test_a_library_that_gives_the_number_in_its_text_alone(kind, empty_folder, capsys):
    """So does polars."""

    def task(config, folder):
        raise kind("underlying IO error: No space left on device (os error 28)")

    assert "a file or standard output: No space left on device; make room" in refused(capsys, task)


def test_what_was_earned_before_the_disk_was_full_stays(empty_folder, capsys):
    def task(config, folder):
        write_bytes(folder / "agent.safetensors", b"trained for hours")
        raise OSError(errno.ENOSPC, "No space left on device")

    assert run_command("evaluate", ["hydra.run.dir=run"], task) == 2
    assert capsys.readouterr().err == (
        "ganlane evaluate: a file or standard output: No space left on device; "
        "make room there, or write to another disk.\n"
    )
    assert (empty_folder / "run" / "agent.safetensors").read_bytes() == b"trained for hours"


def test_a_run_folder_below_a_file(empty_folder, capsys):
    (empty_folder / "file").write_text("no folder")
    err = refused(capsys, lambda config, folder: None, "hydra.run.dir=file/run")
    assert "file/run: Not a directory; check the path." in err


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() == 0, reason="the administrator may write anywhere"
)
def test_a_folder_without_the_right_to_write(empty_folder, capsys):
    empty_folder.chmod(0o555)
    try:
        assert "Permission denied; check the permissions" in refused(
            capsys, lambda config, folder: None
        )
    finally:
        empty_folder.chmod(0o755)


def test_what_no_user_can_mend_keeps_its_traceback(empty_folder):
    def task(config, folder):
        raise ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused")

    with pytest.raises(ConnectionRefusedError):
        run_command("evaluate", [], task)
    assert list(empty_folder.rglob("*")) == []
    assert not is_users_matter(OSError("libfile.so: undefined symbol"))
    assert not is_users_matter(ValueError(errno.ENOSPC))


@pytest.mark.parametrize("number", ADVICE, ids=errno.errorcode.get)
def test_every_refusal_has_a_sentence(number):
    told = sentence(OSError(number, os.strerror(number), "a.txt"))
    assert told == f"a.txt: {os.strerror(number)}; {ADVICE[number]}."
    assert is_users_matter(OSError(number, ""))
