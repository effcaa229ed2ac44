"""Checked numbers, and calls of what an import path names; one sentence per error."""

from __future__ import annotations

import importlib
import inspect
import operator
import sys
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any, TypeVar, get_type_hints

from ganlane.errors import UserError

F = TypeVar("F", bound=Callable)
Made = TypeVar("Made")


def whole_number(name: str, value: Any, low: int, high: int) -> int:
    """``value`` as an int; NumPy's integers are allowed.

    Raises:
        UserError: not an integer, or not from ``low`` to ``high``.
    """
    try:
        # Takes NumPy's integers, and refuses arrays and floats that happen to be whole.
        number = operator.index(value)
    except TypeError:
        number = low - 1  # out of range, so refused

    # Python counts True as 1; as a seed or a number it is a mistake.
    if isinstance(value, bool) or not low <= number <= high:
        # Written as a power, since nobody recognises 9223372036854775807.
        most = "2**63 - 1" if high == 2**63 - 1 else f"{high}"
        shown = " ".join(repr(value).split())
        raise UserError(
            f"{name}={shown:.80}: expected a whole number from {low} to {most}; give for "
            f"instance {name}={low}."
        )
    return number


def seed_number(seed: Any) -> int:
    """A seed, checked: the counters of the environment hold 63 bits."""
    return whole_number("seed", seed, 0, 2**63 - 1)


def is_import_path(name: str) -> bool:
    """Whether ``name`` has the form ``my.module.MyTraffic``, as names of files may too."""
    return "." in name and all(part.isidentifier() for part in name.split("."))


def is_function_path(name: str) -> bool:
    """Whether ``name`` has the form ``my.module:function``."""
    module, colon, function = name.partition(":")
    return bool(colon) and is_import_path(f"{module}.{function}")


def imported(path: str, key: str) -> Any:
    """What is at the import path ``path``, ``my.module.name`` or ``my.module:name``.

    Importing a module executes it: ``path`` must come from the user's command line or call, or be
    of this package (:func:`ganlane.config.run`). ``key`` is the configuration's, for error
    messages.

    Raises:
        UserError: it cannot be imported.
    """
    module, _, name = path.replace(":", ".").rpartition(".")
    # A console script does not search the working folder for modules. It is added last, and only
    # when a module is named, so that no file there replaces an installed module.
    if "" not in sys.path:
        sys.path.append("")
    try:
        return getattr(importlib.import_module(module), name)
    except AttributeError as error:
        raise UserError(
            f"{key}={path}: {module} has no {name}; give the import path of a class or function."
        ) from error
    except Exception as error:  # a user's module can raise anything when imported
        raise UserError(
            f"{key}={path}: {module or path!r} cannot be imported ({type(error).__name__}: "
            f"{error}); give the import path of a class or function, and start the command in the "
            "folder that holds its module."
        ) from error


def import_target(path: str, key: str, base: type[Made]) -> Callable[..., Made]:
    """The subclass of ``base``, or the function annotated to return one, at import path ``path``.

    Raises:
        UserError: it cannot be imported (:func:`imported`), or does not make a ``base``.
    """
    target = imported(path, key)
    if not _makes(target, base):
        raise UserError(
            f"{key}={path}: expected a subclass of "
            f"{base.__module__.removesuffix('.base')}.{base.__name__} or a "
            f"function that is annotated to return one (-> {base.__name__}); derive or annotate "
            "yours."
        )
    return target


def _makes(target: Any, base: type) -> bool:
    """Whether ``target`` is a subclass of ``base``, or a function annotated to return one."""
    if not inspect.isclass(target):
        if not inspect.isfunction(target):
            return False
        # Only the annotation of the result is resolved: others may name what is not imported.
        annotation = target.__annotations__.get("return")
        returned = SimpleNamespace(__annotations__={"return": annotation})
        try:
            target = get_type_hints(returned, inspect.unwrap(target).__globals__)["return"]
        except Exception:  # an annotation may be any expression
            return False
    return inspect.isclass(target) and issubclass(target, base)


def signature_of(target: Callable[..., Any]) -> inspect.Signature:
    """The arguments of ``target``; for a class those of its ``__init__``.

    For a class with an ``__init__`` Python below 3.11.4 gives those of a base's ``__new__``, which
    accepts anything for modules of TensorDict.
    """
    if not inspect.isclass(target):
        return inspect.signature(target)

    # The first class that has either, as Python from 3.11.4 on looks them up.
    for ancestor in target.__mro__[:-1]:
        for name in ("__init__", "__new__"):
            if name in vars(ancestor):
                signature = inspect.signature(getattr(ancestor, name))
                parameters = list(signature.parameters.values())
                # The first one is self or cls.
                return signature.replace(parameters=parameters[1:])
    # Neither anywhere: the constructor is that of object, which takes nothing.
    return inspect.Signature()


def call_with(
    target: Callable[..., Any], offered: Mapping[str, Any], required: Mapping[str, Any], key: str
) -> Any:
    """Call ``target`` with all of ``required`` and those of ``offered`` that its signature names.

    Raises:
        UserError: ``target`` does not accept an argument of ``required``, or needs one that is
            missing.
    """
    signature = signature_of(target)
    parameters = signature.parameters

    # A constructor names what it wants to be told.
    accepted = {name: value for name, value in offered.items() if name in parameters}
    arguments = {**accepted, **required}

    # Checked before the call, so that a TypeError from within the target is not taken for ours.
    try:
        signature.bind(**arguments)
    except TypeError as error:
        name = f"{target.__module__}.{getattr(target, '__qualname__', target)}"
        offer = ", ".join(sorted(arguments)) or "nothing"
        takes = ", ".join(parameters) or "nothing"
        raise UserError(
            f"{key}={name}: cannot be called with {offer} ({error}); it takes {takes}."
        ) from error
    return target(**arguments)
