"""Processor, threads, graphics card and C++ compiler."""

from __future__ import annotations

import os
import shutil
import sys

from ganlane.diagnosis.finding import BROKEN, Finding, State, guarded

_CUDA_PAGE = "install torch for CUDA as https://pytorch.org/get-started/locally/ says"


def machine() -> list[Finding]:
    """What the commands can compute on."""
    looks = (("processor", _processor), ("devices", _devices), ("C++ compiler", _compiler))
    return [guarded(subject, look, BROKEN) for subject, look in looks]


def _processor() -> Finding:
    """Usable cores, and how many threads torch would take by itself."""
    from ganlane.evaluation.provenance import machine

    told = machine()
    threads = f"torch by itself takes {told['threads']} threads, the commands one (threads=N for more)"
    return Finding("processor", State.OK, f"{told['cores']} usable cores, {told['cpu']}; {threads}")


def _devices() -> Finding:
    """The values that device=... can have here; a card that torch cannot use is told of."""
    import torch

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if count:
        cards = ", ".join(torch.cuda.get_device_name(number) for number in range(count))
        return Finding("devices", State.OK, f"cpu, cuda ({cards}; CUDA {torch.version.cuda})")
    if shutil.which("nvidia-smi"):
        return Finding("devices", State.ABSENT, "cpu; a graphics card that torch does not see", _CUDA_PAGE)
    return Finding("devices", State.OK, "cpu (no CUDA device)")


def _compiler() -> Finding:
    """The C++ compiler that ``env.compile=true`` needs, and nothing else; ``CXX`` names another one."""
    from ganlane.runtime import COMPILERS

    named = os.environ.get("CXX")
    looked_for = (named,) if named else COMPILERS
    path = next(filter(None, map(shutil.which, looked_for)), None)
    if path is None:
        found = f"none (looked for {', '.join(looked_for)}); env.compile=true needs one"
        return Finding("C++ compiler", State.ABSENT, found, _compiler_command())
    return Finding("C++ compiler", State.OK, f"{path} (for env.compile=true)")


def _compiler_command() -> str:
    return {"darwin": "xcode-select --install", "win32": "install the Visual Studio build tools"}.get(
        sys.platform, "apt install g++   (Debian, Ubuntu)"
    )
