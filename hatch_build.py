"""Puts the native kernel into the wheel, so that whoever installs it needs no compiler.

Runs when a wheel is built (``pip install .`` builds one), with the compiler that
:mod:`ganlane.native.library` finds: g++, clang++ or, where none works, Clang from the package
``ziglang``, which is then fetched for the build. What cannot be built is told of, and tried again
at first use, as in an editable install; where that fails too, the tensor code drives.
"""

from __future__ import annotations

import sys
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT))

from ganlane.native import library  # noqa: E402 - from this checkout
from ganlane.runtime import has_compiler  # noqa: E402


class KernelHook(BuildHookInterface):
    """Compiles every variant that this kind of machine may run."""

    def dependencies(self) -> list[str]:
        """Clang from a wheel, where no compiler works."""
        return [] if sys.platform == "win32" or has_compiler() else ["ziglang>=0.13"]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile into the build folder, and add what was built to the wheel."""
        if self.target_name != "wheel" or version == "editable":
            return
        built, troubles = library.build_all(Path(self.directory) / "native")
        for trouble in troubles:
            self.app.display_warning(f"native kernel: {trouble}")
        if not built:
            self.app.display_warning("the wheel has no native kernel")
            return
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["pure_python"], build_data["tag"] = False, f"py3-none-{platform}"
        for path in built:
            build_data["force_include"][str(path)] = f"ganlane/native/prebuilt/{path.name}"
