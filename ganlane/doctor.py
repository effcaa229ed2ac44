"""``ganlane doctor``: what is installed and found, what is missing.

    ganlane doctor

Prints the versions of the dependencies, the extras' among them, devices, threads, whether the
native kernel can be built and drives right, and the recordings. Nothing is written but the kernel,
to its cache. What is MISSING is needed; what is absent serves further purposes only.

exit status: 0 all that is needed is there, 1 something needed is missing, 2 a mistake on the
command line
"""

# This must run in a broken installation: other parts are imported inside functions, and a failed
# import is a finding.

from __future__ import annotations

import platform
import re
import sys
from collections.abc import Callable, Sequence
from functools import partial
from importlib import metadata

from ganlane._version import __version__
from ganlane.errors import USER_ERROR, UserError
from ganlane.runtime import check_process


def devices() -> str:
    """Possible values of ``device``, and the threads."""
    import torch

    cards = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    cuda = ""
    if cards:
        cuda = f", cuda ({', '.join(cards)}; CUDA {torch.version.cuda})"
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

    # The same five decisions, by both.
    positions = []
    for name in ("native", "torch"):
        env = HighwayEnv(IdmMobilTraffic(), num_envs=16, kernel=name)
        state = env.reset()
        for _ in range(5):
            state[keys.ACTION] = env.action_spec.zeros()
            state = env.step(state)["next"]
        positions.append(state[keys.VEHICLES, "x"])

    # The two round differently. Not `>=`, since NaN has to fail.
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
        # On one line, whatever the error's own are.
        reason = (str(error) or repr(error)).split()
        print(f"{state} {subject:<32}", *reason)
        return not needed


def examine() -> bool:
    """Print a line about everything; whether all that is needed is there."""
    print(f"ganlane {__version__}, Python {platform.python_version()} ({sys.executable})")

    whole = True
    # Those of extras end in a marker, "; extra == 'sb3'". Whether versions fit says pip check.
    for requirement in metadata.requires("ganlane") or []:
        if re.search("(dev|docs|test)['\"]$", requirement):  # which serve a checkout alone
            continue
        name = re.split(r"[^\w-]", requirement)[0]
        version = partial(metadata.version, name)
        whole &= look(name, version, needed="extra ==" not in requirement)

    look("native kernel", kernel)
    look("recordings", recordings)
    return look("devices", devices, needed=True) and whole


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
