"""Names of Python objects in a configuration: imported and called, with a sentence for what can go wrong."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping
from typing import Any

from ganlane.errors import UserError


def import_target(path: str, key: str) -> Any:
    """The object at import path ``path`` (``my.module.MyTraffic``).

    Args:
        path: module and name.
        key: where the user wrote it, for the message.

    Raises:
        UserError: it cannot be imported.
    """
    module, _, name = path.rpartition(".")
    try:
        return getattr(importlib.import_module(module), name)
    except AttributeError as error:
        raise UserError(
            f"{key}={path}: {module} has no {name}; give the import path of a class or function."
        ) from error
    except Exception as error:  # whatever a user's module does when it is imported
        raise UserError(
            f"{key}={path}: {module or path!r} cannot be imported ({type(error).__name__}: {error}); give the import "
            "path of a class or function, and start the command in the folder that holds its module."
        ) from error


def call_with(target: Callable[..., Any], offered: Mapping[str, Any], own: Mapping[str, Any], key: str) -> Any:
    """``target(...)`` with all of ``own`` and those of ``offered`` that its signature names.

    Raises:
        UserError: ``own`` holds what the target does not take, or something that it needs is not there.
    """
    parameters = inspect.signature(target).parameters
    arguments = {**{name: value for name, value in offered.items() if name in parameters}, **own}
    try:
        inspect.signature(target).bind(**arguments)
    except TypeError as error:
        takes = ", ".join(parameters) or "nothing"
        raise UserError(
            f"{key}={_name(target)}: cannot be called with {', '.join(sorted(arguments)) or 'nothing'} ({error}); "
            f"it takes {takes}."
        ) from error
    return target(**arguments)


def _name(target: Any) -> str:
    return f"{target.__module__}.{getattr(target, '__qualname__', target)}"
