"""A value of a wrong type or out of its range is refused in one sentence, for every key of every
command and option.

The values are made from the dataclasses: every key gets a value of a wrong type, and every key that
has a range one outside of it, once.
"""

from __future__ import annotations

import dataclasses
import math
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import pytest
from ganlane.config.command_line import sentence, typed
from ganlane.config.schemas import SCHEMAS, node_of
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from reference.hydra_memory import composed, own_part
from reference.refusals import refusal

from ganlane.__main__ import COMMANDS
from ganlane.errors import UserError
from ganlane.files import conf_folder
from ganlane.settings.record import NO_KEY

SCENE = Path(__file__).parent / "reference" / "scene.csv"

pytestmark = pytest.mark.usefixtures("hydra_from_memory")


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """Commands run in a folder of their own."""
    monkeypatch.chdir(tmp_path)


@dataclasses.dataclass(frozen=True)
class Key:
    """A key of a command as its dataclass declares it.

    ``chosen`` are the options that it belongs to.
    """

    command: str
    name: str
    kind: Any
    owner: type
    chosen: tuple[str, ...] = ()

    def __str__(self) -> str:
        return " ".join((self.command, *self.chosen, self.name))


def keys_of(
    config: Any, command: str, chosen: tuple[str, ...] = (), prefix: str = ""
) -> Iterator[Key]:
    """All keys below a dataclass, with their declared types."""
    kinds = get_type_hints(type(config))
    for field in dataclasses.fields(config):
        value, name = getattr(config, field.name), f"{prefix}{field.name}"
        if field.metadata == NO_KEY:
            continue
        if dataclasses.is_dataclass(value):
            yield from keys_of(value, command, chosen, f"{name}.")
        elif isinstance(value, dict) and any(map(dataclasses.is_dataclass, value.values())):
            for part, below in value.items():
                yield from keys_of(below, command, chosen, f"{name}.{part}.")
        else:
            yield Key(command, name, kinds[field.name], type(config), chosen)


def keys_of_options() -> Iterator[Key]:
    """The keys that options have beside those of the default of their group."""
    homes = {"data": "prepare", "generator": "train_generator"}
    needs = {
        "env=scene": (f"env.scene.path={SCENE}",),
        "data=ngsim": ("data.path=x",),
        "data=highd": ("data.path=x",),
    }
    for group, option in [
        (group, option) for group, options in SCHEMAS.items() if group for option in options
    ]:
        command, name = homes.get(group, "train"), f"{group}={option}"
        # The forms of the observation share one schema, which is not an option.
        if group == "observation" or not (conf_folder() / group / f"{option}.yaml").is_file():
            continue
        chosen = (name, *needs.get(name, ()))
        known = {key.name for key in KEYS if key.command == command}
        for key in keys_of(option_of(command, group, option, chosen), command, chosen, f"{group}."):
            if key.name not in known:
                yield key


def option_of(command: str, group: str, option: str, chosen: tuple[str, ...]) -> Any:
    """What an option's dataclass holds.

    Composing takes hundreds of times as long, so only where it has to be.
    """
    try:
        return SCHEMAS[group][option]()
    except UserError:
        return getattr(typed(in_memory(command, chosen)), group)


def in_memory(command: str, chosen: tuple[str, ...]) -> Any:
    """The configuration of a command with chosen options and keys."""
    options = tuple(each for each in chosen if (conf_folder() / each.partition("=")[0]).is_dir())
    config = own_part(composed(command, options))
    for each in chosen:
        if each not in options:
            OmegaConf.update(config, *each.split("=", 1))
    return config


TYPED = {command: typed(own_part(composed(command))) for command in COMMANDS}
KEYS = [key for command, config in TYPED.items() for key in keys_of(config, command)]
OPTION_KEYS = list(keys_of_options())


def plain_kind(kind: Any) -> Any:
    """``int`` for ``int | None``, ``list`` for ``list[str]``."""
    if get_origin(kind) in (Union, types.UnionType):
        kind = next(part for part in get_args(kind) if part is not type(None))
    return get_origin(kind) or kind


#: What no key of a kind takes.
WRONG_TYPE = {
    int: "many",
    float: "many",
    bool: "perhaps",
    str: ["a"],
    list: {"a": 1},
    tuple: {"a": 1},
    dict: 3,
}
#: What a key of a kind with a range could refuse, the likeliest first.
ABSURD: dict[Any, tuple[Any, ...]] = {
    int: (-(10**9), 10**15, 0),
    float: (-1e9, 0.0, 1e15, math.nan),
    str: ("no-such-value", ""),
    list: ([], ["no-such-value"], [-1, -2], [math.nan, 1.0]),
}


def with_value(config: Any, names: list[str], value: Any) -> Any:
    """A copy of a dataclass in which a key, however deep, has another value.

    Its ranges are checked.
    """
    first, *deeper = names
    if isinstance(config, dict):
        return {**config, first: with_value(config[first], deeper, value)}
    below = with_value(getattr(config, first), deeper, value) if deeper else value
    return dataclasses.replace(config, **{first: below})


def refused_in_memory(key: Key, value: Any) -> bool:
    """Whether the dataclasses refuse the value; some thousand times as fast as the command."""
    try:
        if not key.chosen:
            with_value(TYPED[key.command], key.name.split("."), value)
        else:
            group, option = key.chosen[0].split("=")
            config = option_of(key.command, group, option, key.chosen)
            with_value(config, key.name.split(".")[1:], value)
    except (UserError, TypeError):  # of the wrong kind altogether: Hydra looks at no range
        return True
    return not is_list_of_kind(key.kind, value)


def is_list_of_kind(kind: Any, value: Any) -> bool:
    """Whether a list holds what it is declared to hold; anything else passes."""
    kinds = [part for part in (kind, *get_args(kind)) if get_origin(part) is list]
    wanted = get_args(kinds[0])[0] if kinds else str
    return (
        wanted is str
        or not isinstance(value, list)
        or all(isinstance(each, (int, float)) for each in value)
    )


def as_typed(value: Any) -> str:
    """A value as it is given on the command line."""
    if isinstance(value, list):
        return f"[{','.join(map(as_typed, value))}]"
    return "''" if value == "" else str(value)


#: Every key once, whichever commands have it: the types and ranges are those of its dataclass.
EVERY_KEY = {key.name: key for key in KEYS + OPTION_KEYS}


@pytest.mark.parametrize(
    "key", [key for key in EVERY_KEY.values() if plain_kind(key.kind) in WRONG_TYPE], ids=str
)
def test_a_key_refuses_a_wrong_type(key):
    field = key.name.rsplit(".", 1)[-1]
    with pytest.raises(OmegaConfBaseException) as caught:
        node_of(key.owner)[field] = WRONG_TYPE[plain_kind(key.kind)]
    told = sentence(caught.value)
    assert told.startswith(f"{field}")
    assert told.endswith(".")
    assert "\n" not in told


def absurd_value(key: Key) -> Any:
    """A value of the right type that the key refuses; None if it takes them all."""
    return next(
        (value for value in ABSURD.get(plain_kind(key.kind), ()) if refused_in_memory(key, value)),
        None,
    )


OUT_OF_RANGE = {
    name: (key, value)
    for name, key in EVERY_KEY.items()
    if (value := absurd_value(key)) is not None
}


@pytest.mark.parametrize("name", sorted(OUT_OF_RANGE))
def test_a_key_refuses_what_is_out_of_range(name, capsys):
    key, value = OUT_OF_RANGE[name]
    err = refusal(capsys, key.command, *key.chosen, f"{name}={as_typed(value)}")
    assert name.rsplit(".", 1)[-1] in err or str(value) in err


def test_nearly_every_number_has_a_range():
    numbers = {name for name, key in EVERY_KEY.items() if plain_kind(key.kind) in (int, float)}
    assert len(numbers) > 100
    assert numbers <= OUT_OF_RANGE.keys()
