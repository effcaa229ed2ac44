"""A value of a wrong type is refused in one sentence, for every key of every command and option."""

import types
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import pytest

from ganlane.config.run import COMMANDS, call_settings
from ganlane.errors import UserError
from ganlane.settings.record import NO_KEY, make, option_names, plain

SCENE = Path(__file__).parent / "reference" / "scene.csv"
#: Calls that reach every record: each command, and each option of a group in a command that has it.
CALLS: list[tuple[str, dict[str, Any]]] = [
    *((command, {}) for command in COMMANDS),
    *(("train", {"traffic": name}) for name in option_names("traffic")),
    *(("train_generator", {"generator": name}) for name in option_names("generator")),
    *(("prepare", {"data": {"name": name, "path": "x"}}) for name in ("ngsim", "highd")),
    *(("train", {"env": name}) for name in ("cut_in", "blocked_lane", "stop_and_go")),
    ("train", {"env": {"name": "scene", "scene": {"path": SCENE}}}),
    ("train", {"observation": {"sensors": {"delay_s": 1}}}),
]
#: What no key of a kind takes, and what one with a range would not.
WRONG_TYPE: dict[Any, Any] = {
    int: "many",
    float: "many",
    bool: "perhaps",
    str: ["a"],
    list: {"a": 1},
    tuple: {"a": 1},
    dict: 3,
}
OUT_OF_RANGE: dict[Any, Any] = {int: -(10**9), float: float("nan"), str: "no-such-value"}


def kind_and_rules(hint: Any) -> tuple[Any, bool]:
    """``int`` for ``int | None``, ``list`` for ``list[str]``; whether a range is declared."""
    has_range = False
    while get_origin(hint) in (Union, types.UnionType, Annotated):
        has_range = has_range or get_origin(hint) is Annotated
        parts = get_args(hint)
        if get_origin(hint) is Annotated:
            hint = parts[0]
        else:
            hint = next(part for part in parts if part is not type(None))
    return get_origin(hint) or hint, has_range


def keys_of(
    record: Any, above: tuple[str, ...] = ()
) -> Iterator[tuple[type, tuple[str, ...], Any]]:
    """The class, key and annotation of every value below a record."""
    hints = get_type_hints(type(record), include_extras=True)
    for field in fields(record):
        value, path = getattr(record, field.name), (*above, field.name)
        if field.metadata == NO_KEY:
            continue
        if is_dataclass(value):
            yield from keys_of(value, path)
        else:
            yield type(record), path, hints[field.name]


def refusal_of(record: Any, path: tuple[str, ...], value: Any) -> str:
    """The error of the record's constructor with another value at ``path``."""
    data = plain(record)
    inner = data
    for part in path[:-1]:
        inner = inner[part]
    inner[path[-1]] = value
    with pytest.raises(UserError) as caught:
        make(type(record), data)
    return str(caught.value)


@cache
def places() -> dict[tuple[type, str], tuple[Any, tuple[str, ...], Any]]:
    """Every key of every record once: the whole where it stands first, and its annotation."""
    first = {}
    for command, keys in CALLS:
        whole = call_settings(command, keys)
        for record, path, hint in keys_of(whole):
            first.setdefault((record, path[-1]), (whole, path, hint))
    return first


def test_every_key_refuses_a_wrong_type():
    for whole, path, hint in places().values():
        kind, _ = kind_and_rules(hint)
        if kind in WRONG_TYPE and path[-1] not in ("traffics", "against"):
            told = refusal_of(whole, path, WRONG_TYPE[kind])
            assert told.startswith(".".join(path)), told
            assert "expected" in told
            assert "\n" not in told


def test_every_key_with_a_range_refuses_what_is_outside():
    for whole, path, hint in places().values():
        kind, has_range = kind_and_rules(hint)
        # A text that must not be empty takes any other.
        if has_range and kind in OUT_OF_RANGE and not (kind is str and "not empty" in str(hint)):
            assert "expected" in refusal_of(whole, path, OUT_OF_RANGE[kind]), path
