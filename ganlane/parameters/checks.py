"""Range checks of parameters as rules with names, and help for frozen dataclasses."""

from __future__ import annotations

import difflib
import inspect
import math
import operator
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence, Set
from dataclasses import MISSING, Field, fields
from functools import cache, wraps
from numbers import Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Final, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from ganlane.errors import ParameterError, UserError, as_typed

Record = TypeVar("Record")
F = TypeVar("F", bound=Callable)
#: Metadata of a field that is set from Python alone: OmegaConf leaves such fields out of a schema.
NO_KEY: Final[Mapping[str, Any]] = {"omegaconf_ignore": True}


class Rule(NamedTuple):
    """Whether a value will do, and what was expected in words."""

    holds: Callable[[Any], bool]
    expected: str


def _finite(value: Any) -> bool:
    """Whether a number is finite, and fits into 64 bits if it is whole."""
    return abs(value) < (2**63 if isinstance(value, int) else math.inf)


def at_least(low: float) -> Rule:
    """Finite and not below ``low``."""
    return Rule(lambda value: _finite(value) and value >= low, f"at least {as_typed(low)}")


def above(low: float) -> Rule:
    """Finite and above ``low``."""
    return Rule(lambda value: _finite(value) and value > low, f"a number above {as_typed(low)}")


def below(high: float) -> Rule:
    """Finite and below ``high``."""
    return Rule(lambda value: _finite(value) and value < high, f"a number below {as_typed(high)}")


def at_most(high: float) -> Rule:
    """Finite and not above ``high``."""
    return Rule(lambda value: _finite(value) and value <= high, f"at most {as_typed(high)}")


def between(low: float, high: float) -> Rule:
    """From ``low`` to ``high``, both included."""
    return Rule(
        lambda value: _finite(value) and low <= value <= high, f"a number from {as_typed(low)} to {as_typed(high)}"
    )


def number() -> Rule:
    """Finite."""
    return Rule(_finite, "a finite number")


def text() -> Rule:
    """Not empty."""
    return Rule(lambda value: isinstance(value, str) and value != "", "a text that is not empty")


def one_of(names: Iterable[str]) -> Rule:
    """One of ``names``."""
    known = tuple(names)
    return Rule(lambda value: isinstance(value, Hashable) and value in known, f"one of {', '.join(known)}")


def speed_range() -> Rule:
    """Two numbers, the first at least 0 and not above the second."""
    return Rule(
        lambda value: len(value) == 2 and all(map(_finite, value)) and 0 <= value[0] <= value[1],
        "two numbers [low, high], 0 <= low <= high",
    )


def positive_range() -> Rule:
    """Two numbers above 0, the first not above the second."""
    return Rule(lambda value: speed_range().holds(value) and value[0] > 0, "two numbers [low, high], 0 < low <= high")


def every(rule: Rule) -> Rule:
    """A list, not empty, of which every entry obeys ``rule``."""
    return Rule(
        lambda values: len(values) > 0 and all(rule.holds(value) for value in values),
        f"a list, not empty, each entry {rule.expected}",
    )


def optional(rule: Rule) -> Rule:
    """Null, or as ``rule`` has it."""
    return Rule(lambda value: value is None or rule.holds(value), f"null or {rule.expected}")


def check(record: Any, **rules: Rule) -> None:
    """Check fields of a dataclass against ``rules``, given by field name.

    Raises:
        ParameterError: for the first value out of range; names field, value, what was expected, and a valid value.
    """
    known = {field.name: field for field in fields(record)}
    for name, rule in rules.items():
        value = getattr(record, name)
        if not rule.holds(value):
            advice = _advice(known[name])
            raise ParameterError(f"{{{name}}}={as_typed(value)}: expected {rule.expected}{advice}.")


def _advice(field: Field[Any]) -> str:
    """The default as an example, where there is one."""
    default = field.default_factory() if field.default_factory is not MISSING else field.default
    return f"; give for instance {{{field.name}}}={as_typed(default)}" if default not in (MISSING, None, "") else ""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A hint such as `` (did you mean 'lanes'?)``; empty where nothing is close."""
    close = difflib.get_close_matches(name, list(known), n=1)
    return f" (did you mean '{close[0]}'?)" if close else ""


def assign(record: Any, **values: Any) -> None:
    """Set fields of a frozen ``record``; for its ``__post_init__``, or of a copy that is not to be checked."""
    for name, value in values.items():
        object.__setattr__(record, name, value)


def lists_to_tuples(record: Any) -> None:
    """Turn lists, which YAML and the command line give, into tuples; for a ``__post_init__`` alone."""
    for field in fields(record):
        value = getattr(record, field.name)
        if isinstance(value, list):
            assign(record, **{field.name: tuple(value)})


def part_of(record: Any, kind: type[Record]) -> Record:
    """The fields that ``record`` inherits from ``kind``, as a ``kind``."""
    return kind(**{field.name: getattr(record, field.name) for field in fields(kind)})  # type: ignore[arg-type]


def whole_number(name: str, value: Any, low: int, high: int) -> int:
    """``value`` as an int; NumPy's integers are allowed.

    Raises:
        UserError: it is none, or not from ``low`` to ``high``.
    """
    if not _is_whole(value) or not low <= int(value) <= high:
        most = "2**63 - 1" if high == 2**63 - 1 else f"{high}"
        raise UserError(
            f"{name}={_shown(value)}: expected a whole number from {low} to {most}; give for instance {name}={low}."
        )
    return int(value)


def _is_whole(value: Any) -> bool:
    """Whether it counts as an int: NumPy's do, truth values and arrays do not."""
    try:
        operator.index(value)
    except TypeError:
        return False
    return not isinstance(value, bool)


def _shown(value: Any) -> str:
    """``value`` on one line, cut off where it is long."""
    return f"{' '.join(repr(value).split()):.80}"


def seed_number(seed: Any) -> int:
    """A seed, checked: the counters of the environment hold 63 bits."""
    return whole_number("seed", seed, 0, 2**63 - 1)


def checked_arguments(function: F) -> F:
    """``function``, which refuses arguments of other types than its annotations say, before it does anything.

    NumPy's numbers count as Python's; a text holds no zero byte, which no path and no name can; where ``Any`` stands,
    alone or in a union, everything will do.

    Raises:
        UserError: for the first such argument.
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
    """Whether a value is of the type that an annotation says."""
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
    if getattr(kind, "_is_protocol", False):  # scenes of a user's own have what is needed of them
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
