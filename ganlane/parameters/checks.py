"""Range checks of parameters, as rules with names."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable
from dataclasses import MISSING, Field, fields
from typing import Any, NamedTuple

from ganlane.errors import ParameterError


class Rule(NamedTuple):
    """Whether a value will do, and what was expected in words."""

    holds: Callable[[Any], bool]
    expected: str


def _finite(value: Any) -> bool:
    return math.isfinite(value)


def at_least(low: float) -> Rule:
    """Finite and not below ``low``."""
    return Rule(lambda value: _finite(value) and value >= low, f"at least {_shown(low)}")


def above(low: float) -> Rule:
    """Finite and above ``low``."""
    return Rule(lambda value: _finite(value) and value > low, f"a number above {_shown(low)}")


def below(high: float) -> Rule:
    """Finite and below ``high``."""
    return Rule(lambda value: _finite(value) and value < high, f"a number below {_shown(high)}")


def at_most(high: float) -> Rule:
    """Finite and not above ``high``."""
    return Rule(lambda value: _finite(value) and value <= high, f"at most {_shown(high)}")


def between(low: float, high: float) -> Rule:
    """From ``low`` to ``high``, both included."""
    return Rule(
        lambda value: _finite(value) and low <= value <= high, f"a number from {_shown(low)} to {_shown(high)}"
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
    return Rule(lambda value: value in known, f"one of {', '.join(known)}")


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


def check(config: Any, where: str = "", /, **rules: Rule) -> None:
    """Hold fields of a dataclass against ``rules``.

    Args:
        config: the dataclass.
        where: key of the record on the command line, where it has only one; empty for the records of
            :mod:`ganlane.parameters`, which do not know theirs, and at the root.
        rules: by field name.

    Raises:
        ParameterError: for the first value that will not do; names field, value, what was expected, and a value
            that does.
    """
    known = {field.name: field for field in fields(config)}
    for name, rule in rules.items():
        value = getattr(config, name)
        if not rule.holds(value):
            advice = _advice(known[name])
            raise ParameterError(f"{{{name}}}={_shown(value)}: expected {rule.expected}{advice}.", where)


def _advice(field: Field[Any]) -> str:
    """The default as an example, where there is one."""
    default = field.default_factory() if field.default_factory is not MISSING else field.default
    return f"; give for instance {{{field.name}}}={_shown(default)}" if default not in (MISSING, None, "") else ""


def _shown(value: Any) -> str:
    """As one would type it."""
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, list | tuple):
        return f"[{','.join(map(_shown, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A hint such as `` (did you mean 'lanes'?)``; empty where nothing is close."""
    close = difflib.get_close_matches(name, list(known), n=1)
    return f" (did you mean '{close[0]}'?)" if close else ""
