"""Help for frozen dataclasses: fields settled when one is made, and the part that one inherits."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeVar

Record = TypeVar("Record")


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
