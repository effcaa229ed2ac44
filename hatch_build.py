"""Puts the native kernel into the wheel, so that whoever installs it needs no compiler.

Runs when a wheel is built (``pip install .`` builds one), with the compiler that
:mod:`ganlane.native.library` finds: g++, clang++ or, where there is none, Clang from the package
``ziglang``, which is then fetched for the build. Without any of them the wheel has no kernel, and
the tensor code drives. An editable install builds at first use.
"""

from __future__ import annotations

import sys
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT))

from ganlane.errors import UserError  # noqa: E402 - from this checkout
from ganlane.native import library  # noqa: E402


class KernelHook(BuildHookInterface):
    """Compiles every variant that this kind of machine may run."""

    def dependencies(self) -> list[str]:
        """Clang from a wheel, where there is no compiler."""
        here = sys.platform != "win32" and library.compiler_command() is not None
        return [] if here or sys.platform == "win32" else ["ziglang>=0.13"]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile into the build folder, and add what was built to the wheel."""
        if self.target_name != "wheel" or version == "editable":
            return
        try:
            built = library.build_all(Path(self.directory) / "native")
        except UserError as error:
            self.app.display_warning(f"the wheel has no native kernel: {error}")
            return
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["pure_python"], build_data["tag"] = False, f"py3-none-{platform}"
        for path in built:
            build_data["force_include"][str(path)] = f"ganlane/native/prebuilt/{path.name}"
