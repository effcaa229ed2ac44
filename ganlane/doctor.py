"""``ganlane doctor``: what is installed and found, what is missing, and how to fix it.

    ganlane doctor

Prints versions, devices, threads, compiler, configuration, shipped weights (each is loaded),
recordings, cache, run folders and extras. Nothing is written. What is MISSING is needed; what is
absent serves further purposes only.

exit status: 0 all that is needed is there, 1 something needed is missing, 2 a mistake on the
command line
"""

# This must run in a broken installation: other parts are imported inside functions, and a failed
# import is a finding.

from __future__ import annotations

import importlib
import os
import platform
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Final

from ganlane._version import __version__
from ganlane.errors import USER_ERROR, UserError
from ganlane.files import CACHE_VARIABLE, CHECKPOINTS, cache_folder, conf_folder
from ganlane.runtime import check_process, find_compiler

NEEDED_IS_MISSING = 1
PYTHON: Final = (3, 10)
#: As in ``pyproject.toml``; a test compares them.
REQUIRED: Final = (
    "torch>=2.11,<2.14",
    "torchrl>=0.14.1,<0.15",
    "tensordict>=0.14.3,<0.15",
    "gymnasium>=1.1,<2",
    "hydra-core>=1.3.6,<1.4",
    "matplotlib>=3.8",
    "numpy>=1.26",
    "polars>=1.30",
    "pillow>=10.1",
    "safetensors>=0.4.5",
    "scikit-learn>=1.4",
    "scipy>=1.11",
    "tqdm>=4.66",
)
#: Extra to its purpose and what it installs, as in ``pyproject.toml``.
EXTRAS: Final = {
    "video": ("films as mp4", ("imageio>=2.34", "imageio-ffmpeg>=0.5")),
    "tensorboard": ("logger=tensorboard", ("tensorboard>=2.16",)),
    "bench": (
        "peers of ganlane bench",
        ("highway-env>=1.10", "stable-baselines3>=2.4", "eclipse-sumo>=1.20", "libsumo>=1.20"),
    ),
    "sb3": ("ganlane.sb3", ("stable-baselines3>=2.4", "sb3-contrib>=2.4")),
    "human": ("render_mode=human", ("pygame-ce>=2.1.3",)),
    "minari": ("ganlane record", ("minari[hdf5]>=0.5.2",)),
    "notebook": (
        "examples/quickstart.ipynb",
        ("ipykernel>=6.29", "nbclient>=0.10", "nbformat>=5.10"),
    ),
    "native": ("env.kernel=native without a compiler", ("ziglang>=0.13",)),
    "sumo": ("traffic=sumo", ("eclipse-sumo>=1.20", "libsumo>=1.20")),
    "wandb": ("logger=wandb", ("wandb>=0.18",)),
    "ray": ("distributed collection", ("ray>=2.40",)),
    "sweeps": ("sweeps in several processes", ("hydra-joblib-launcher>=1.2",)),
    "slurm": ("sweeps as Slurm jobs", ("hydra-submitit-launcher>=1.2",)),
    "ray-sweeps": ("sweeps on a Ray cluster", ("hydra-ray-launcher>=1.2.1",)),
    "docs": (
        "building these pages",
        ("mkdocs-material>=9.5", "mkdocstrings[python]>=0.27", "ruff>=0.8", "latex2mathml>=3.77"),
    ),
}
#: Distributions whose module has another name.
MODULES: Final = {"hydra-core": "hydra", "pillow": "PIL", "scikit-learn": "sklearn"}
#: Weights without which the commands' defaults do not run.
NEEDED_WEIGHTS: Final = ("agent_idm", "generator_paper", "generator_calibrated")
_REINSTALL: Final = (
    "python -m pip install --force-reinstall --no-deps PATH_OF_THE_CHECKOUT_OR_WHEEL"
)
_FIX_FIRST: Final = "fix what is MISSING above, then run ganlane doctor again"
_CUDA_PAGE: Final = "install torch for CUDA as https://pytorch.org/get-started/locally/ says"
_INSTALL_COMPILER: Final = {
    "darwin": "xcode-select --install",
    "win32": "install the Visual Studio build tools",
}


class State(Enum):
    """``MISSING`` is needed and makes the exit status 1; ``ABSENT`` is optional."""

    OK = "ok"
    ABSENT = "absent"
    MISSING = "MISSING"


@dataclass(frozen=True)
class Finding:
    """Result of a check.

    What was checked, what is there and, if something is missing, the command that fixes it.
    """

    subject: str
    state: State
    found: str
    fix: str = ""


def guarded(subject: str, look: Callable[[], Finding], fix: str = _FIX_FIRST) -> Finding:
    """The result of ``look``.

    Any error is a finding too, since a broken installation can fail in any way.
    """
    try:
        return look()
    except Exception as error:
        message = " ".join(str(error).split()) or type(error).__name__
        return Finding(subject, State.MISSING, message, fix)


def examine() -> dict[str, list[Finding]]:
    """Findings by title of section; loads every shipped checkpoint, so it takes seconds."""
    return {
        "software": [python(), *(guarded(text, partial(required, text)) for text in REQUIRED)],
        "machine": machine(),
        "files": [
            guarded(
                "configuration",
                lambda: Finding("configuration", State.OK, str(conf_folder())),
                _REINSTALL,
            ),
            *checkpoints(),
            guarded("recordings", recordings),
            guarded("cache", cache),
            outputs(),
        ],
        "extras (not needed)": [guarded(f"extra {name}", partial(extra, name)) for name in EXTRAS],
    }


def missing(sections: Mapping[str, Sequence[Finding]]) -> list[str]:
    """Subjects that are needed and not there."""
    return [
        each.subject
        for findings in sections.values()
        for each in findings
        if each.state is State.MISSING
    ]


def report(sections: Mapping[str, Sequence[Finding]]) -> str:
    """All findings, section by section, and the conclusion as last line."""
    blocks = []
    for title, findings in sections.items():
        lines = [title]
        for each in findings:
            lines.append(f"  {each.state.value:<8}{each.subject:<22}{each.found}")
            lines += [f"          fix: {each.fix}"] if each.fix else []
        blocks.append("\n".join(lines))
    conclusion = "All that is needed is there; what is absent serves further purposes only."
    if lacking := missing(sections):
        conclusion = f"Missing: {', '.join(lacking)}; run the commands after 'fix:'."
    return "\n\n".join([*blocks, conclusion])


def installed(text: str) -> tuple[str, str | None, bool]:
    """A requirement's distribution, its installed version (None.

    Not installed), and whether that satisfies it.
    """
    from packaging.requirements import Requirement  # Hydra's and torch's own

    requirement = Requirement(text)
    try:
        version = metadata.version(requirement.name)
    except metadata.PackageNotFoundError:
        return requirement.name, None, False
    return requirement.name, version, requirement.specifier.contains(version, prereleases=True)


def _install(*requirements: str) -> str:
    return " ".join(["python -m pip install", *(f'"{text}"' for text in requirements)])


def python() -> Finding:
    """The interpreter."""
    version = f"{platform.python_version()} ({sys.executable})"
    if sys.version_info >= PYTHON:
        return Finding("python", State.OK, version)
    needed = ".".join(map(str, PYTHON))
    return Finding(
        "python", State.MISSING, version, f"a virtual environment with Python {needed} or newer"
    )


def required(text: str) -> Finding:
    """Whether a requirement is installed in a suitable version and can be imported."""
    name, version, fits = installed(text)
    if version is None or not fits:
        lacking = (
            "not installed" if version is None else f"{version}, needed {text.removeprefix(name)}"
        )
        return Finding(name, State.MISSING, lacking, _install(text))

    def look() -> Finding:
        importlib.import_module(MODULES.get(name, name))
        return Finding(name, State.OK, version)

    return guarded(name, look, f"{_install(text)} --force-reinstall")


def extra(name: str) -> Finding:
    """Whether everything of an extra is installed; nothing of it is imported."""
    purpose, texts = EXTRAS[name]
    parts = {text: installed(text) for text in texts}
    lacking = [text for text, (_, _, fits) in parts.items() if not fits]
    if lacking:
        without = ", ".join(parts[text][0] for text in lacking)
        return Finding(
            f"extra {name}", State.ABSENT, f"{purpose}: {without} not installed", _install(*lacking)
        )
    return Finding(
        f"extra {name}",
        State.OK,
        ", ".join(f"{part} {version}" for part, version, _ in parts.values()),
    )


def machine() -> list[Finding]:
    """What the commands can compute on."""
    return [
        guarded("processor", _processor),
        guarded("devices", _devices),
        guarded("C++ compiler", _compiler),
    ]


def _processor() -> Finding:
    """Usable cores, and how many threads torch would take by itself."""
    from ganlane.evaluation import machine

    here = machine()
    threads = (
        f"torch by itself takes {here['threads']} threads, the commands one (threads=N for more)"
    )
    return Finding("processor", State.OK, f"{here['cores']} usable cores, {here['cpu']}; {threads}")


def _devices() -> Finding:
    """Possible values of ``device``; also reports a graphics card that torch cannot use."""
    import torch

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if count:
        cards = ", ".join(torch.cuda.get_device_name(number) for number in range(count))
        return Finding("devices", State.OK, f"cpu, cuda ({cards}; CUDA {torch.version.cuda})")
    if shutil.which("nvidia-smi"):
        return Finding(
            "devices", State.ABSENT, "cpu; a graphics card that torch does not see", _CUDA_PAGE
        )
    return Finding("devices", State.OK, "cpu (no CUDA device)")


def _compiler() -> Finding:
    """The C++ compiler that only ``env.compile=true`` needs; ``CXX`` names another one."""
    path, names = find_compiler()
    if path is None:
        fix = _INSTALL_COMPILER.get(sys.platform, "apt install g++   (Debian, Ubuntu)")
        return Finding(
            "C++ compiler",
            State.ABSENT,
            f"none (looked for {names}); env.compile=true needs one",
            fix,
        )
    return Finding("C++ compiler", State.OK, f"{path} (for env.compile=true)")


def checkpoints() -> list[Finding]:
    """The weights that ship, each of them loaded."""
    names = sorted({*NEEDED_WEIGHTS, *(path.stem for path in CHECKPOINTS.glob("*.safetensors"))})
    return [
        guarded(name, partial(_weights, CHECKPOINTS / f"{name}.safetensors"), _REINSTALL)
        for name in names
    ]


def _weights(path: Path) -> Finding:
    """Whether a checkpoint can be loaded."""
    if path.stem.startswith("generator_"):
        from ganlane.generator import load_generator

        load_generator(path)
    else:
        from ganlane.agents import load_agent
        from ganlane.agents.checkpoint import with_seeds

        for agent in with_seeds(f"{path}@all") if path.stem.startswith("seeds_of_") else [path]:
            load_agent(agent)
    return Finding(path.stem, State.OK, f"{path} ({_megabytes(path)})")


def recordings() -> Finding:
    """The recordings used with ``data.path=null``.

    Needed for fitting and realism, not for training or driving.
    """
    from ganlane.data.sources import DATA_VARIABLE, SCENES, default_scenes

    try:
        path = default_scenes()
    except UserError as error:
        fix = f"export {DATA_VARIABLE}=FOLDER   (one that holds {SCENES}), or give data.path=FILE (docs/own_data.md)"
        return Finding("recordings", State.ABSENT, str(error).partition("; ")[0], fix)
    return Finding("recordings", State.OK, f"{path} ({_megabytes(path)})")


def cache() -> Finding:
    """The folder in which groups of windows are kept between fits."""
    folder = cache_folder()
    if folder is None:
        return Finding("cache", State.OK, f"off ({CACHE_VARIABLE} is empty)")
    if not _can_write(folder):
        return Finding(
            "cache",
            State.ABSENT,
            f"{folder} cannot be written to",
            f"export {CACHE_VARIABLE}=FOLDER",
        )
    files = list(folder.glob("*.npz"))
    return Finding("cache", State.OK, f"{folder} ({len(files)} files, {_megabytes(*files)})")


def outputs() -> Finding:
    """The folder of the commands' run folders."""
    folder = Path("outputs").resolve()
    if _can_write(folder):
        return Finding("run folders", State.OK, f"below {folder}")
    return Finding(
        "run folders", State.MISSING, f"{folder} cannot be written to", "cd to a folder of your own"
    )


def _can_write(folder: Path) -> bool:
    """Whether files can be made in ``folder``, or it can be made."""
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    return existing.is_dir() and os.access(existing, os.W_OK)


def _megabytes(*files: Path) -> str:
    return f"{sum(path.stat().st_size for path in files) / 2**20:.1f} MB"


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if {"-h", "--help"} & set(arguments):
        print((__doc__ or "").strip())
        return 0
    try:
        if arguments:
            raise UserError(f"{arguments[0]}: it takes no keys; run ganlane doctor alone.")
        check_process()
    except UserError as error:
        print(f"ganlane doctor: {error}", file=sys.stderr)
        return USER_ERROR
    sections = examine()
    print(f"ganlane {__version__}\n\n{report(sections)}")
    return NEEDED_IS_MISSING if missing(sections) else 0


if __name__ == "__main__":
    sys.exit(main())
