"""The foreign simulators' packages, imported when they are asked for."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

from ganlane.errors import UserError


def require(module: str, traffic: str, package: str, extra: str) -> ModuleType:
    """The module, imported.

    Args:
        module: its name.
        traffic: the option of the group ``traffic`` that needs it.
        package: as it is called on PyPI.
        extra: of ours that brings it.

    Raises:
        UserError: it is not installed.
    """
    if find_spec(module.partition(".")[0]) is None:
        raise UserError(f"traffic {traffic}: {package} is not installed; pip install 'ganlane[{extra}]' brings it.")
    return import_module(module)
