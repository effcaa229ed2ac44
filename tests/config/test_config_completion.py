"""Shell completion: what a line could become, and that bash, zsh and fish get to see it.

The shells are real ones, as far as they are installed; each is told what docs/command_line.md tells
its user.
"""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from ganlane.__main__ import COMMANDS, PLAIN_COMMANDS, candidates, main

ROOT = Path(__file__).resolve().parents[2]
NAMES = [*COMMANDS, *PLAIN_COMMANDS]
TRAFFICS = sorted(path.stem for path in (ROOT / "conf" / "traffic").glob("*.yaml"))


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("ganlane", NAMES),
        ("ganlane ", NAMES),
        ("ganlane tr", ["train", "train_generator"]),
        ("ganlane nothing", []),
        ("ganlane nothing traffic=", []),
        ("ganlane doctor ", []),
        ("ganlane train traffic=", [f"traffic={name}" for name in TRAFFICS]),
        (
            "ganlane train traffic=idm_",
            ["traffic=idm_faults", "traffic=idm_mobil", "traffic=idm_random"],
        ),
        ("ganlane train env.lane", ["env.lane_width_m=", "env.lanes="]),
        ("ganlane train -m seed=0,1 total_", ["total_decisions="]),
        ("ganlane evaluate episodes", ["episodes="]),
        ("ganlane train env=scene env.scene.p", ["env.scene.path="]),
    ],
)
def test_the_last_word_is_completed(line, expected):
    assert candidates(line) == expected


def test_a_key_is_completed_with_its_present_value():
    assert candidates("ganlane train env.lanes=") == ["env.lanes=3"]
    assert candidates("ganlane train env=dense env.vehicles=") == ["env.vehicles=30"]


def test_nothing_of_hydras_and_no_schema_is_offered():
    offered = candidates("ganlane train ")
    assert {"traffic=", "seed=", "env."} <= set(offered)
    assert not [word for word in offered if "schema" in word or word.startswith("hydra")]


@pytest.mark.parametrize("arguments", [["-sc", "install=bash"], ["train", "-sc", "install=bash"]])
def test_the_script_for_the_shell_registers_the_console_script(arguments, capsys):
    assert main(arguments) == 0
    assert capsys.readouterr().out.rstrip().endswith("-F hydra_bash_completion ganlane")


@pytest.mark.parametrize("flag", ["-sc", "--shell-completion"])
@pytest.mark.parametrize("asked", ["install=tcsh", "install", "mend=bash", ""])
def test_another_shell_is_refused(flag, asked, capsys):
    assert main([flag, *asked.split()]) == 2
    assert "shells: bash, zsh, fish" in capsys.readouterr().err


# --- in the shells


@pytest.fixture
def environment(tmp_path):
    """The console script on the path, as an installation puts it there, and nothing of the user's."""
    program = tmp_path / "bin" / "ganlane"
    program.parent.mkdir()
    program.write_text(
        f"#!{sys.executable}\nimport sys\nfrom ganlane.__main__ import main\nsys.exit(main())\n",
        encoding="utf-8",
    )
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    path = f"{program.parent}:{Path(sys.executable).parent}:{os.environ['PATH']}"
    return {"PATH": path, "PYTHONPATH": str(ROOT), "HOME": str(tmp_path), "TERM": "vt100"}


def typed(shell: str, script: str, environment: dict[str, str], *flags: str) -> str:
    """What a script prints in a shell."""
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    start = [shell, *flags, "-c", script]
    done = subprocess.run(
        start,
        env=environment,
        cwd=environment["HOME"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.stderr == ""
    return done.stdout


#: What bash does when TAB is pressed at the end of a line.
BASH = """
press_tab() {
    COMP_LINE="$1" COMP_POINT=${#1} COMP_WORDS=($1) COMP_CWORD=$((${#COMP_WORDS[@]} - 1)) COMPREPLY=()
    [[ "$1" == *" " ]] && COMP_CWORD=$((COMP_CWORD + 1))
    hydra_bash_completion
    echo "${COMPREPLY[*]}"
}
eval "$(ganlane -sc install=bash)"
complete -p ganlane
press_tab 'ganlane tr'
press_tab 'ganlane train traffic='
eval "$(ganlane -sc uninstall=bash)"
complete -p ganlane 2> /dev/null || echo gone
"""


def test_bash_completes_and_forgets(environment):
    registered, *offered, last = typed(
        "bash", BASH, environment, "--norc", "--noprofile"
    ).splitlines()
    assert registered.endswith("-F hydra_bash_completion ganlane")
    assert offered == ["train train_generator", " ".join(f"traffic={name}" for name in TRAFFICS)]
    assert last == "gone"


FISH = """
ganlane -sc install=fish | source
complete -C 'ganlane tr'
complete -C 'ganlane train traffic='
ganlane -sc uninstall=fish | source
complete -C 'ganlane train traffic='
"""


def test_fish_completes_and_forgets(environment):
    offered = typed("fish", FISH, environment, "--no-config").splitlines()
    # the folders that happen to be here
    offered = [each for each in offered if not each.endswith("/")]
    assert offered == ["train", "train_generator", *(f"traffic={name}" for name in TRAFFICS)]


#: Keys pressed in an interactive zsh on a terminal of its own; each read waits until its pattern
#: has appeared.
ZSH = r"""
zmodload zsh/zpty
zpty z 'PS1= zsh -f -i'
zpty -w z 'eval "$(ganlane -sc install=zsh)"; LISTMAX=0; unsetopt beep; echo IN''STALLED'
zpty -r z seen '*INSTALLED*'
zpty -n -w z $'ganlane evaluate epi\t'
zpty -r z seen '*episodes=*'
print completed
zpty -n -w z $'\C-uganlane train traffic=\t'
zpty -r z seen '*gan_calibrated*replay*'
print listed
zpty -n -w z $'\C-u'
zpty -w z 'eval "$(ganlane -sc uninstall=zsh)"; print ${_comps[ganlane]:-GO''NE}'
zpty -r z seen '*GONE*'
print forgotten
zpty -d z
"""


def test_zsh_completes_and_forgets(environment):
    assert typed("zsh", ZSH, environment, "-f").split() == ["completed", "listed", "forgotten"]
