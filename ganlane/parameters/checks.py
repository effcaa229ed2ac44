"""Range checks of parameters as rules with names, and help for frozen dataclasses."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, Field, fields
from typing import Any, Final, NamedTuple, TypeVar

from ganlane.errors import ParameterError, UserError, as_typed

Record = TypeVar("Record")
#: Metadata of a field that is set from Python alone: OmegaConf leaves such fields out of a schema.
NO_KEY: Final[Mapping[str, Any]] = {"omegaconf_ignore": True}


class Rule(NamedTuple):
    """Whether a value will do, and what was expected in words."""

    holds: Callable[[Any], bool]
    expected: str


def _finite(value: Any) -> bool:
    return math.isfinite(value)


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
    if isinstance(value, bool) or not hasattr(value, "__index__") or not low <= int(value) <= high:
        most = "2**63 - 1" if high == 2**63 - 1 else f"{high}"
        raise UserError(
            f"{name}={value}: expected a whole number from {low} to {most}; give for instance {name}={low}."
        )
    return int(value)


def seed_number(seed: Any) -> int:
    """A seed, checked: the counters of the environment hold 63 bits."""
    return whole_number("seed", seed, 0, 2**63 - 1)
