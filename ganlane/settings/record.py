"""Records: frozen dataclasses whose constructor takes plain data and says what is wrong with it.

YAML, command line, Python calls and saved runs all end here, so a parameter is declared once::

    @dataclass(frozen=True)
    class Agent(Record):
        gamma: Annotated[float, between(0, 1)] = 0.98

    Agent(gamma=2)                      # gamma=2: expected a number from 0 to 1; give for ...
    make(Run, {"agent": {"gama": 0.9}}) # agent.gama: no such key (did you mean 'gamma'?); ...
    make(Run, {"agent": "dqn"})         # what conf/agent/dqn.yaml says
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from numbers import Real
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Final,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import yaml

from ganlane.errors import CONTROL, ParameterError, UserError, as_typed, did_you_mean
from ganlane.files import conf_folder

Part = TypeVar("Part")
#: Metadata of a field that is set from Python alone: no key of the command line or of a file.
NO_KEY: Final[Mapping[str, Any]] = {"no_key": True}


# --- ranges


class Rule(NamedTuple):
    """Whether a value of the right type will do, and what was expected in words."""

    holds: Callable[[Any], bool]
    expected: str


def _finite(value: float) -> bool:
    """Whether a number is finite, and fits into 64 bits if it is whole."""
    # Larger whole numbers do not fit into an int64 of NumPy or torch.
    return abs(value) < (2**63 if isinstance(value, int) else math.inf)


def at_least(low: float) -> Rule:
    """Finite and not below ``low``."""
    return Rule(lambda value: _finite(value) and value >= low, f"at least {as_typed(low)}")


def between(low: float, high: float) -> Rule:
    """From ``low`` to ``high``, both included."""
    expected = f"a number from {as_typed(low)} to {as_typed(high)}"
    return Rule(lambda value: low <= value <= high, expected)


def up_to(high: float, reason: str = "") -> Rule:
    """Above 0 and not above ``high``; ``reason`` ends the sentence."""
    return Rule(lambda value: 0 < value <= high, f"a number above 0, at most {high:.0f}{reason}")


def one_of(names: Iterable[str]) -> Rule:
    """One of ``names``."""
    allowed = tuple(names)
    return Rule(lambda value: value in allowed, f"one of {', '.join(allowed)}")


def _is_range(pair: tuple[float, float]) -> bool:
    return _finite(pair[0]) and _finite(pair[1]) and 0 <= pair[0] <= pair[1]


#: A list without repetitions.
DIFFERENT = Rule(
    lambda entries: len(entries) == len(set(entries)) > 0, "a list of different entries, not empty"
)

Number = Annotated[float, Rule(_finite, "a finite number")]
Positive = Annotated[float, Rule(lambda value: _finite(value) and value > 0, "a number above 0")]
Negative = Annotated[float, Rule(lambda value: _finite(value) and value < 0, "a number below 0")]
NotNegative = Annotated[float, at_least(0)]
NotPositive = Annotated[float, Rule(lambda value: _finite(value) and value <= 0, "at most 0")]
Share = Annotated[float, between(0, 1)]
PositiveShare = Annotated[float, up_to(1)]
Count = Annotated[int, at_least(1)]
CountOrZero = Annotated[int, at_least(0)]
#: Up to 2**53 a whole number survives as a float, as in JSON.
Seed = Annotated[int, between(0, 2**53)]
Text = Annotated[str, Rule(bool, "a text that is not empty")]
#: Lowest and highest value, from 0 on; or above 0.
Range = Annotated[tuple[float, float], Rule(_is_range, "two numbers [low, high], 0 <= low <= high")]
PositiveRange = Annotated[
    tuple[float, float],
    Rule(lambda pair: _is_range(pair) and pair[0] > 0, "two numbers [low, high], 0 < low <= high"),
]


# --- options: a YAML file each


def option_names(group: str) -> list[str]:
    """Names of a group's options, the files ``conf/GROUP/NAME.yaml``."""
    return sorted(path.stem for path in (conf_folder() / group).glob("*.yaml"))


def option(group: str, name: Any) -> dict[str, Any]:
    """What ``conf/GROUP/NAME.yaml`` says: the keys that differ from the record's defaults.

    Raises:
        ParameterError: no such option.
    """
    names = option_names(group)
    if name not in names:
        hint = did_you_mean(str(name), names)
        raise ParameterError(
            f"{group}={as_typed(name):.80}: no such option{hint}; choose one of {', '.join(names)}."
        )
    file = conf_folder() / group / f"{name}.yaml"
    return yaml.safe_load(file.read_text(encoding="utf-8")) or {}


#: Keys whose names with numbers are one value: it replaces the one below, as on the command line.
ONE_VALUE = frozenset({"scored", "shown", "shares"})


def merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """``below`` with ``above`` on top, mapping by mapping; one with a ``name`` begins anew."""
    result = dict(below)
    for name, value in above.items():
        before = result.get(name)
        begins_anew = name in ONE_VALUE or not isinstance(value, Mapping) or "name" in value
        if isinstance(before, Mapping) and not begins_anew:
            value = merged(before, value)
        result[name] = value
    return result


# --- records


class Record:
    """Base class of the records: the constructor checks types and ranges, field by field.

    A nested record may be given as a mapping of its keys, or by the name of an option if its class
    has a ``group``. ``{"name": "gan", "noise_scale": 0.5}`` is that option with changes.

    Attributes:
        group: folder of ``conf/`` with the options; empty: none.
        chosen_by: field whose value tells which subclass is meant; empty: there are none.
        alone: field that a text stands for where there is no ``group``; empty: none.

    Raises:
        ParameterError: for the first value that will not do; names field, value, what was expected,
            and a valid value.
    """

    group: ClassVar[str] = ""
    chosen_by: ClassVar[str] = ""
    alone: ClassVar[str] = ""

    def __post_init__(self) -> None:
        hints = _hints(type(self))  # type: ignore[arg-type]
        # In the order of the fields, so that the first mistake is the one reported.
        for field in fields(self):  # type: ignore[arg-type]
            name = field.name
            try:
                assign(self, **{name: _fitted(hints[name], getattr(self, name), name)})
            except _Refusal as refusal:
                raise refusal.told(field) from refusal.__cause__

    @classmethod
    def kinds(cls) -> dict[str, type[Record]]:
        """The class and its subclasses by the default of the field ``chosen_by``, if it has one."""
        kinds = [kind for kind in (cls, *cls.__subclasses__()) if hasattr(kind, cls.chosen_by)]
        return {getattr(kind, cls.chosen_by): kind for kind in kinds}

    @classmethod
    def chosen(cls, data: Any) -> tuple[type[Record], Any]:
        """The class that ``data`` ask for, and the data of its constructor."""
        # A name is the option of that name; a mapping with a name is that option with changes.
        short = "name" if cls.group else cls.alone
        if isinstance(data, str) and short:
            data = {short: data}
        if isinstance(data, Mapping) and cls.group and "name" in data:
            changes = {name: value for name, value in data.items() if name != "name"}
            data = merged(option(cls.group, data["name"]), changes)
        if not cls.chosen_by or not isinstance(data, Mapping) or cls.chosen_by not in data:
            return cls, data
        kinds, choice = cls.kinds(), data[cls.chosen_by]
        if not isinstance(choice, str) or choice not in kinds:
            raise ParameterError(
                f"{{{cls.chosen_by}}}={as_typed(choice)}: expected one of {', '.join(kinds)}; "
                "choose one of these."
            )
        return kinds[choice], data


def make(kind: type[Part], data: Any, key: str = "") -> Part:
    """A record of ``kind`` from plain data; ``key`` is its own, for messages.

    Raises:
        ParameterError: for the first key or value that will not do, by its whole key.
    """
    # A record was checked when it was made.
    if isinstance(data, kind):
        return data
    with below(key):
        chosen, values = kind.chosen(data)  # type: ignore[attr-defined]
    if not isinstance(values, Mapping):
        options = "the name of an option or " if chosen.group else ""
        raise ParameterError(
            f"{{{key}}}={as_typed(values)}: it has keys of its own; give "
            f"{options}{{{key}}}.NAME=VALUE."
        )
    # Unknown keys first: a mistyped key is the commonest mistake.
    names = key_names(chosen)
    for name in values:
        if name not in names:
            whole = f"{key}.{name}" if key else name
            owner = f"{{{key}}} has" if key else "known are"
            hint = did_you_mean(str(name), names)
            raise ParameterError(
                f"{{{whole}}}: no such key{hint}; {owner} {', '.join(sorted(names))}."
            )
    with below(key):
        return chosen(**values)


@contextmanager
def below(key: str) -> Iterator[None]:
    """Put ``key`` before the fields that an error names."""
    try:
        yield
    except ParameterError as error:
        # With the inner error's cause, so that a traceback does not show the same error twice.
        raise (error.below(key) if key else error) from error.__cause__


def key_names(kind: Any) -> list[str]:
    """The fields of a record that are keys."""
    return [field.name for field in fields(kind) if field.metadata != NO_KEY]


def assign(record: Any, **values: Any) -> None:
    """Set fields of a frozen ``record``, for its ``__post_init__``."""
    for name, value in values.items():
        object.__setattr__(record, name, value)


def part_of(record: Any, kind: type[Part]) -> Part:
    """The fields that ``record`` inherits from ``kind``, as a ``kind``."""
    return kind(**{field.name: getattr(record, field.name) for field in fields(kind)})  # type: ignore[arg-type]


def plain(record: Any) -> Any:
    """The keys and values of a record as mappings, lists, texts and numbers, for a YAML file."""
    if is_dataclass(record):
        return {name: plain(getattr(record, name)) for name in key_names(record)}
    if isinstance(record, Mapping):
        return {str(name): plain(value) for name, value in record.items()}
    if isinstance(record, list | tuple):
        return [plain(entry) for entry in record]
    return record


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


_WORDS = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "a text",
    dict: "names with values, {name: value}",
}


class _Refusal(Exception):
    """A value that will not do: its key, the value, and what was expected in words."""

    def told(self, field: Field[Any]) -> ParameterError:
        """The sentence about it, with an example of the ``field``."""
        key, value, expected = self.args
        # The default is a value that works, so it serves as the example.
        default = field.default
        if field.default_factory is not MISSING:
            default = field.default_factory()
        example = ""
        if default not in (MISSING, None, "") and not isinstance(default, dict | Record):
            example = f"; give for instance {{{field.name}}}={as_typed(default)}"
        text = " ".join(as_typed(value).split())
        return ParameterError(f"{{{key}}}={text:.80}: expected {expected}{example}.")


def _fitted(hint: Any, value: Any, key: str) -> Any:
    """``value`` as the annotation ``hint`` wants it, its ranges checked."""
    # Peel the annotation from the outside: optional, ranges, then what the value itself is.
    kind, inner = get_origin(hint) or hint, get_args(hint)
    # Records have unions with None only.
    if kind in (Union, UnionType):
        if value is None:
            return None
        present = next(alternative for alternative in inner if alternative is not NoneType)
        return _fitted(present, value, key)
    if kind is Annotated:
        value = _fitted(inner[0], value, key)
        for rule in inner[1:]:
            if not rule.holds(value):
                raise _Refusal(key, value, rule.expected)
        return value
    if is_dataclass(kind):
        return make(kind, value, key)  # type: ignore[arg-type]
    if hasattr(value, "tolist"):  # NumPy's and torch's numbers and arrays
        value = value.tolist()
    if kind in (list, tuple):
        # A set or an array is as good as a list; a mapping is a mistake.
        one = isinstance(value, str) or (kind is list and isinstance(value, Path | int))
        entries = [value] if one else value  # agents=mobil, episodes=3
        if not isinstance(entries, Collection) or isinstance(entries, Mapping):
            raise _Refusal(key, value, "a list in brackets")
        if kind is tuple and inner[1] is not Ellipsis and len(entries) != len(inner):
            raise _Refusal(key, value, f"{len(inner)} entries")
        return kind(_fitted(inner[0], entry, key) for entry in entries)
    if kind is dict and isinstance(value, Mapping):
        return {
            _scalar(str, str(name), key): _fitted(inner[1], entry, f"{key}.{name}")
            for name, entry in value.items()
        }
    return _scalar(kind, value, key)


def _scalar(kind: Any, value: Any, key: str) -> Any:
    """A number, text or switch of the type ``kind``."""
    if kind is Any:
        return value
    # bool is a subclass of int, but true is no number.
    if isinstance(value, bool) and kind is not bool:
        raise _Refusal(key, value, _WORDS[kind])
    is_number = isinstance(value, Real)
    if kind is float and is_number:
        try:
            return float(value)
        except OverflowError as error:
            raise _Refusal(key, value, "a number of fewer digits") from error
    # YAML reads 1e6 as a float.
    if kind is int and isinstance(value, float) and value.is_integer():
        return int(value)  # 1e6
    if kind is int and hasattr(value, "__index__"):
        return operator.index(value)
    if kind is str and (is_number or isinstance(value, Path)):
        return str(value)
    if kind is str and isinstance(value, str) and CONTROL.search(value):
        raise _Refusal(key, value, "a text without control characters")
    if isinstance(value, kind):
        return value
    raise _Refusal(key, value, _WORDS.get(kind, kind.__name__))


# --- saved settings

#: A saved configuration is a few kB and five levels deep; PyYAML's time grows with the square of
#: the depth, so a file of brackets would keep it busy for hours.
LARGEST_CONFIG_BYTES, DEEPEST_CONFIG = 2**18, 50


def saved_config(path: Path) -> dict[str, Any]:
    """Plain data of a run's ``config.yaml``.

    Raises:
        UserError: the file is missing or damaged.
    """
    try:
        if path.stat().st_size > LARGEST_CONFIG_BYTES:
            raise ValueError("too large")
        text = path.read_text(encoding="utf-8")
        depth = 0
        for event in yaml.parse(text, yaml.SafeLoader):
            # Aliases can make a short file endless; a saved configuration has none.
            if isinstance(event, yaml.AliasEvent):
                raise ValueError("aliases")
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > DEEPEST_CONFIG:
                raise ValueError("too deep")
        data = yaml.safe_load(text)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise UserError(
            f"{path}: missing or damaged, so the run cannot be resumed; start a new run."
        ) from error
    if not isinstance(data, dict):
        raise UserError(f"{path}: damaged, expected key: value lines; start a new run.")
    return data
