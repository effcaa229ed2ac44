"""Every number that a user can set: one frozen dataclass per part, with default, range, unit and
source.

Each is declared here and nowhere else. The simulator, the traffic and the agent take these records,
and they are the command line's schemas as they stand (:mod:`ganlane.config`). Annotations hold the
ranges, which are checked when a :class:`Record` is made::

    @dataclass(frozen=True)
    class Pedals(Record):
        gain: Positive = 1.0
        offset: Annotated[float, between(-1, 1)] = 0.0

Errors name the field; the command line puts the key before it. Nothing here imports torch, nor a
package that does (``ganlane.sim`` and the others import it in their ``__init__``): so a mistyped
key is reported before torch, which takes seconds to load. The packages that work with a record
still offer it by name (``ganlane.sim.IdmParameters``).
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from types import UnionType
from typing import (
    Annotated,
    Any,
    Final,
    NamedTuple,
    TypeAlias,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from ganlane.errors import ParameterError, as_typed

Part = TypeVar("Part")
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


def between(low: float, high: float) -> Rule:
    """From ``low`` to ``high``, both included."""
    return Rule(
        lambda value: _finite(value) and low <= value <= high,
        f"a number from {as_typed(low)} to {as_typed(high)}",
    )


def one_of(names: Iterable[str]) -> Rule:
    """One of ``names``."""
    known = tuple(names)
    return Rule(
        lambda value: isinstance(value, Hashable) and value in known, f"one of {', '.join(known)}"
    )


def _is_range(value: Any) -> bool:
    return len(value) == 2 and all(map(_finite, value)) and 0 <= value[0] <= value[1]


#: A list without repetitions.
DIFFERENT = Rule(
    lambda all: len(all) > 0 and len(set(all)) == len(all), "a list of different entries, not empty"
)

Number: TypeAlias = Annotated[float, Rule(_finite, "a finite number")]
Positive: TypeAlias = Annotated[
    float, Rule(lambda value: _finite(value) and value > 0, "a number above 0")
]
Negative: TypeAlias = Annotated[
    float, Rule(lambda value: _finite(value) and value < 0, "a number below 0")
]
NotNegative: TypeAlias = Annotated[float, at_least(0)]
NotPositive: TypeAlias = Annotated[
    float, Rule(lambda value: _finite(value) and value <= 0, "at most 0")
]
Share: TypeAlias = Annotated[float, between(0, 1)]
PositiveShare: TypeAlias = Annotated[
    float, Rule(lambda value: 0 < value <= 1, "a number above 0, at most 1")
]
Count: TypeAlias = Annotated[int, at_least(1)]
CountOrZero: TypeAlias = Annotated[int, at_least(0)]
Seed: TypeAlias = Annotated[int, between(0, 2**53)]
Text: TypeAlias = Annotated[str, Rule(lambda value: value != "", "a text that is not empty")]
#: Lowest and highest value, from 0 on; or above 0.
Range: TypeAlias = Annotated[
    tuple[float, float], Rule(_is_range, "two numbers [low, high], 0 <= low <= high")
]
PositiveRange: TypeAlias = Annotated[
    tuple[float, float],
    Rule(
        lambda value: _is_range(value) and value[0] > 0, "two numbers [low, high], 0 < low <= high"
    ),
]


def _every(rule: Rule) -> Rule:
    return Rule(
        lambda values: len(values) > 0 and all(map(rule.holds, values)),
        f"a list, not empty, each entry {rule.expected}",
    )


def _optional(rule: Rule) -> Rule:
    return Rule(lambda value: value is None or rule.holds(value), f"null or {rule.expected}")


def _rules_of(hint: Any) -> list[Rule]:
    """The rules in an annotation.

    Of a value, of every entry of a list or tuple, of what is not null.
    """
    kind, inner = get_origin(hint), get_args(hint)
    if kind is Annotated:
        return [*_rules_of(inner[0]), *inner[1:]]
    if kind in (Union, UnionType):
        return [_optional(rule) for each in inner for rule in _rules_of(each)]
    return [_every(rule) for rule in _rules_of(inner[0])] if kind in (list, tuple) else []


def _is_tuple(hint: Any) -> bool:
    return get_origin(hint) is tuple or any(map(_is_tuple, get_args(hint)))


@cache
def _checks(kind: Any) -> dict[str, tuple[Field[Any], list[Rule], bool]]:
    """The fields of a dataclass, with their rules, or those of its bases for them, and whether they
    are tuples.
    """
    found: dict[str, tuple[list[Rule], bool]] = {}
    for base in kind.__mro__[::-1]:
        hints = get_type_hints(base, include_extras=True) if is_dataclass(base) else {}
        for name, hint in hints.items():
            known = found[name][0] if name in found else []
            found[name] = _rules_of(hint) or known, _is_tuple(hint)
    return {known.name: (known, *found[known.name]) for known in fields(kind)}


class Record:
    """Base class of dataclasses whose fields are checked when one is made.

    Lists, which YAML and the command line give, become tuples where the field is one. A subclass
    that gives a field another default keeps its range.

    Raises:
        ParameterError: for the first value out of range; names field, value, what was expected, and
            a valid value.
    """

    def __post_init__(self) -> None:
        self.check_ranges()

    def check_ranges(self, *names: str) -> None:
        """Check all fields, or those that have to be right before a ``__post_init__`` can go on."""
        checks = _checks(type(self))  # type: ignore[arg-type]
        for name in names or checks:
            value = getattr(self, name)
            field, rules, is_tuple = checks[name]
            if is_tuple and isinstance(value, list):
                value = tuple(value)
                assign(self, **{name: value})
            for rule in rules:
                if not rule.holds(value):
                    default = (
                        field.default_factory()
                        if field.default_factory is not MISSING
                        else field.default
                    )
                    example = f"; give for instance {{{name}}}={as_typed(default)}"
                    advice = example if default not in (MISSING, None, "") else ""
                    raise ParameterError(
                        f"{{{name}}}={as_typed(value)}: expected {rule.expected}{advice}."
                    )


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A hint such as `` (did you mean 'lanes'?)``; empty where nothing is close."""
    close = difflib.get_close_matches(name, list(known), n=1)
    return f" (did you mean '{close[0]}'?)" if close else ""


def assign(record: Any, **values: Any) -> None:
    """Set fields of a frozen ``record``.

    For its ``__post_init__``, or of a copy that is not to be checked.
    """
    for name, value in values.items():
        object.__setattr__(record, name, value)


def part_of(record: Any, kind: type[Part]) -> Part:
    """The fields that ``record`` inherits from ``kind``, as a ``kind``."""
    return kind(**{field.name: getattr(record, field.name) for field in fields(kind)})  # type: ignore[arg-type]
