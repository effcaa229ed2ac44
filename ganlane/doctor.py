"""``ganlane doctor``: what is installed and found, what is missing, and the command that mends it.

    ganlane doctor

Prints the versions of the dependencies and of what the extras bring, devices, threads, whether the
native kernel can be built and drives right, and the recordings. Nothing is written but the kernel,
to its cache. What is MISSING is needed; what is absent serves further purposes only.

exit status: 0 all that is needed is there, 1 something needed is missing, 2 a mistake on the
command line
"""

# This must run in a broken installation: other parts are imported inside functions, and a failed
# import is a finding.

from __future__ import annotations

import importlib
import platform
import re
import sys
from collections.abc import Callable, Sequence
from functools import partial
from importlib import metadata

from ganlane._version import __version__
from ganlane.errors import USER_ERROR, UserError
from ganlane.runtime import check_process

#: Distributions whose module has another name.
MODULES = {"hydra-core": "hydra", "pillow": "PIL", "scikit-learn": "sklearn"}


def dependency(requirement: str) -> str:
    """The version of a requirement's distribution, which is imported where it is needed."""
    from packaging.requirements import Requirement  # Hydra's and torch's own

    wanted = Requirement(requirement)
    install = f'run python -m pip install --force-reinstall "{wanted.name}{wanted.specifier}"'
    try:
        version = metadata.version(wanted.name)
        if wanted.marker is None:
            importlib.import_module(MODULES.get(wanted.name, wanted.name))
    except Exception as error:  # a broken package can fail in any way
        raise UserError(f"{error}; {install}") from error
    if not wanted.specifier.contains(version, prereleases=True):
        raise UserError(f"{version}, needed {wanted.specifier}; {install}")
    return version


def devices() -> str:
    """Possible values of ``device``, and the threads."""
    import torch

    cards = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    cuda = f", cuda ({', '.join(cards)}; CUDA {torch.version.cuda})" if cards else ""
    return f"cpu{cuda}; torch takes {torch.get_num_threads()} threads, a command one"


def kernel() -> str:
    """Instruction set and maker of the native kernel, which has driven as the tensor code does."""
    from ganlane import keys
    from ganlane.env import HighwayEnv
    from ganlane.native import library
    from ganlane.traffic import IdmMobilTraffic

    loaded = library.find()
    if isinstance(loaded, str):
        raise UserError(f"env.kernel=native {loaded}.")
    positions = []
    for name in ("native", "torch"):
        env = HighwayEnv(IdmMobilTraffic(), num_envs=16, kernel=name)
        state = env.reset()
        for _ in range(5):
            state[keys.ACTION] = env.action_spec.zeros()
            state = env.step(state)["next"]
        positions.append(state[keys.VEHICLES, "x"])
    apart_m = float((positions[0] - positions[1]).abs().max())
    if not apart_m < 0.1:
        raise UserError(
            f"{loaded.maker}: its kernel drives {apart_m:g} m away from the tensor code; set CXX "
            "to another compiler, or env.kernel=torch."
        )
    about = f"{loaded.variant}, by {loaded.maker}, drives as the tensor code does"
    return "; ".join((about, *loaded.troubles))


def recordings() -> str:
    """The recordings used with ``data.path=null``: for fitting and realism, not for training."""
    from ganlane.data.sources import default_scenes

    return str(default_scenes())


def look(
    subject: str,
    check: Callable[[], str],
    needed: bool = False,
) -> bool:
    """Print a line about ``subject``; whether nothing that is needed is missing."""
    try:
        print(f"ok       {subject:<32} {check()}")
        return True
    except Exception as error:
        state = "MISSING " if needed else "absent  "
        print(f"{state} {subject:<32}", *(str(error) or repr(error)).split())
        return not needed


def examine() -> bool:
    """Print a line about everything; whether all that is needed is there."""
    print(f"ganlane {__version__}, Python {platform.python_version()} ({sys.executable})")
    whole = True
    # Those of extras end in a marker, "; extra == 'sb3'".
    for requirement in sorted(metadata.requires("ganlane") or [], key=lambda text: ";" in text):
        name, *extra = re.findall(r"^[\w-]+|(?<=extra == .)[\w-]+", requirement)
        if not {"dev", "test", "docs"} & set(extra):  # which serve a checkout alone
            name = " for extra ".join([name, *extra])
            whole &= look(name, partial(dependency, requirement), not extra)
    look("native kernel", kernel)
    look("recordings", recordings)
    return look("devices", devices, True) and whole


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    told = list(sys.argv[1:] if arguments is None else arguments)
    if {"-h", "--help"} & set(told):
        print((__doc__ or "").strip())
        return 0
    try:
        if told:
            raise UserError(f"{told[0]}: it takes no keys; run ganlane doctor alone.")
        check_process()
    except UserError as error:
        print(f"ganlane doctor: {error}", file=sys.stderr)
        return USER_ERROR
    return 0 if examine() else 1
