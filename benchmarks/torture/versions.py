"""Installs the lowest and the highest versions of every dependency, and runs a short list of
commands.

Environments are made by ``uv`` where it is installed, else by pip. Where the lower bounds of
``pyproject.toml`` do not install together, each is tried alone.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.torture.tally import Tally

ROOT = Path(__file__).resolve().parents[2]
#: What must work in every environment; {out} is an empty folder.
SMOKE = (
    "ganlane --version",
    "ganlane evaluate agents=[mobil,agent_idm,random_legal] traffics=[idm,gan,gan_calibrated,idm_random] episodes=2",
    "ganlane train traffic=gan init=idm_ckpt total_decisions=1024 collector.num_envs=64 evaluation.episodes=2",
    "ganlane render agent=mobil traffic=idm env.goal_m=100 out=film.gif",
    "ganlane realism --help",
    "python -c \"import gymnasium, ganlane; e = gymnasium.make('ganlane/Highway-v0'); e.reset(seed=0); e.step(0)\"",
)


def dependencies() -> list[str]:
    """The requirements of ``pyproject.toml``, without extras."""
    import tomllib  # from Python 3.11 on

    return list(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"])


def lowest(requirement: str) -> str:
    """``torch==2.11`` for ``torch>=2.11,<2.14``."""
    found = re.match(r"([\w-]+)>=([\d.]+)", requirement)
    if found is None:
        raise ValueError(f"{requirement}: no lower bound")
    return f"{found[1]}=={found[2]}"


def versions(tally: Tally, scratch: Path, pins: Sequence[str] = ()) -> str:
    """A table, in Markdown: each dependency's version in each environment.

    ``pins`` stand for requirements of which other versions cannot be had, as ``torch==2.13.0``, in
    all environments.
    """
    pinned = {pin.partition("==")[0]: pin for pin in pins}
    named = [pinned.get(re.split("[<>=]", each)[0], each) for each in dependencies()]
    least = {each: lowest(each) for each in named if each not in pins}
    plans = {
        "highest": named,
        "lowest": [least.get(each, each) for each in named],
        # Each alone at its lower bound, where not all of them install together.
        **{f"lowest {low.partition('==')[0]}": [low, *named] for low in least.values()},
    }
    columns: dict[str, dict[str, str]] = {}
    for name, wanted in plans.items():
        if name.startswith("lowest ") and "lowest" in columns:
            break  # all of them together have passed already
        home = scratch / name.replace(" ", "-")
        if (refused := _install(home, wanted)) is not None:
            tally.what["environments that do not install"] += 1
            tally.detail[f"{name}: {refused}"] += 1
            continue
        columns[name] = _installed(home)
        tally.what["environments"] += 1
        for command in SMOKE:
            done = _run(home, command, scratch / "out")
            tally.what["commands"] += 1
            if done.returncode != 0:
                tally.fail(f"{name}: {command}: {done.stderr[-500:]}")
    names = sorted({re.split(r"[<>=]", each)[0] for each in named})
    rows = ["| dependency | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    rows += [
        f"| {each} | " + " | ".join(column.get(each, "-") for column in columns.values()) + " |"
        for each in names
    ]
    return "\n".join(rows)


def _install(home: Path, wanted: list[str]) -> str | None:
    """Make an environment with the package in it; why it could not be made, else None."""
    if shutil.which("uv"):
        make = ["uv", "venv", "--quiet", "--python", sys.executable, str(home)]
        install = ["uv", "pip", "install", "--quiet", "--python", str(home / "bin" / "python")]
    else:
        make = [sys.executable, "-m", "venv", str(home)]
        install = [
            str(home / "bin" / "python"),
            "-m",
            "pip",
            "install",
            "--quiet",
            "--disable-pip-version-check",
        ]
    for line in (make, [*install, *wanted], [*install, "--no-deps", str(ROOT)]):
        done = subprocess.run(line, capture_output=True, text=True)
        if done.returncode != 0:
            return (done.stderr.strip().splitlines() or ["no reason given"])[-1][:200]
    return None


def _installed(home: Path) -> dict[str, str]:
    program = "import importlib.metadata as m; print(*(f'{d.name}={d.version}' for d in m.distributions()))"
    done = subprocess.run(
        [str(home / "bin" / "python"), "-c", program], capture_output=True, text=True, check=True
    )
    return {
        name.lower().replace("_", "-"): version
        for name, version in (p.split("=") for p in done.stdout.split())
    }


def _run(home: Path, command: str, out: Path) -> subprocess.CompletedProcess[str]:
    """One command of :data:`SMOKE`, in an empty folder."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    path = {"PATH": f"{home / 'bin'}:/usr/bin:/bin", "HOME": str(out), "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, shell=True, cwd=out, env=path, capture_output=True, text=True)
