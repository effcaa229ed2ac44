"""From a config dataclass to the frozen one that the package below works with."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeVar

Parameters = TypeVar("Parameters")


def plain_copy(config: Any, kind: type[Parameters], **replaced: Any) -> Parameters:
    """A ``kind`` with the fields that ``config`` has under the same names; lists become tuples.

    Args:
        config: dataclass of the command line; fields that ``kind`` lacks are left out.
        kind: dataclass below; fields that ``config`` lacks keep their defaults.
        replaced: fields that need a conversion of their own.
    """
    values = {
        field.name: _frozen(getattr(config, field.name))
        for field in fields(kind)  # type: ignore[arg-type]
        if field.init and hasattr(config, field.name)
    }
    return kind(**{**values, **replaced})


def _frozen(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
