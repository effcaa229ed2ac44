"""Checks of the arguments of Python calls."""

from __future__ import annotations

import inspect
import operator
from collections.abc import Callable, Collection, Mapping, Sequence, Set
from functools import cache, wraps
from numbers import Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Final, TypeVar, Union, get_args, get_origin, get_type_hints

from ganlane.errors import UserError

F = TypeVar("F", bound=Callable)


def whole_number(name: str, value: Any, low: int, high: int) -> int:
    """``value`` as an int; NumPy's integers are allowed.

    Raises:
        UserError: not an integer, or not from ``low`` to ``high``.
    """
    if not _is_whole(value) or not low <= int(value) <= high:
        most = "2**63 - 1" if high == 2**63 - 1 else f"{high}"
        raise UserError(
            f"{name}={_shown(value)}: expected a whole number from {low} to {most}; give for instance {name}={low}."
        )
    return int(value)


def _is_whole(value: Any) -> bool:
    """Whether ``value`` counts as an int: NumPy's integers do, booleans and arrays do not."""
    try:
        operator.index(value)
    except TypeError:
        return False
    return not isinstance(value, bool)


def _shown(value: Any) -> str:
    """``value`` on one line of at most 80 characters."""
    return f"{' '.join(repr(value).split()):.80}"


def seed_number(seed: Any) -> int:
    """A seed, checked: the counters of the environment hold 63 bits."""
    return whole_number("seed", seed, 0, 2**63 - 1)


def checked_arguments(function: F) -> F:
    """Decorator: check the types of the arguments against the annotations before ``function`` is called.

    NumPy's numbers count as Python's. A text must not hold a zero byte, which paths and names cannot have. ``Any``,
    alone or in a union, accepts everything.

    Raises:
        UserError: for the first argument of a wrong type.
    """
    signature = inspect.signature(function)
    hints = cache(lambda: get_type_hints(function))  # at the first call, when all modules are imported

    @wraps(function)
    def checked(*arguments: Any, **named: Any) -> Any:
        for name, value in signature.bind(*arguments, **named).arguments.items():
            hint = hints().get(name, Any)
            if not _fits(value, hint):
                raise UserError(f"{name}={_shown(value)}: expected {_in_words(hint)}; correct this argument.")
        return function(*arguments, **named)

    return checked  # type: ignore[return-value]


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value is of the annotated type."""
    kind, inner = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):
        return any(_fits(value, each) for each in inner)
    if kind is Mapping or kind is dict:
        return isinstance(value, Mapping) and all(_fits(key, inner[0]) for key in value)
    if kind is Sequence:  # or an array
        listed = isinstance(value, Collection) and not isinstance(value, str | bytes | Mapping | Set)
        return listed and getattr(value, "ndim", 1) > 0 and all(_fits(each, inner[0]) for each in value)
    if kind is int:
        return _is_whole(value)
    if kind is float:
        return isinstance(value, Real) and not isinstance(value, bool)
    if kind is bool:
        return type(value).__name__ in ("bool", "bool_")  # NumPy's, by either name
    if kind is str:
        return isinstance(value, str) and "\0" not in value
    if getattr(kind, "_is_protocol", False):  # such as that of scenes: a user's class need not inherit
        return callable(value)
    return kind is Any or not inspect.isclass(kind) or isinstance(value, kind)


_NAMES: Final[Mapping[Any, str]] = {
    **{int: "a whole number", float: "a number", bool: "True or False", str: "a text", Path: "a path"},
    **{Mapping: "a mapping of names", dict: "a dictionary", NoneType: "None"},
}


def _in_words(hint: Any) -> str:
    """A type in words."""
    kind, inner = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):
        return " or ".join(_in_words(each) for each in inner if each is not Any)
    if kind is Sequence:
        return f"a list (each entry {_in_words(inner[0])})"
    return _NAMES.get(kind, f"a {getattr(kind, '__name__', kind)}")
