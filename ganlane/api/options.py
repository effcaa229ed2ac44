"""From names, mappings and keyword arguments to the config dataclasses, checked as on the command line."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeAlias

from omegaconf import OmegaConf

from ganlane.config.messages import CONFIG_ERRORS, sentence
from ganlane.config.schemas import made, node_of, option_of, options_of
from ganlane.config.traffic import TrafficConfig
from ganlane.errors import UserError
from ganlane.parameters.checks import did_you_mean

#: An option's name; a mapping of its keys, with its name as ``name``; or its config dataclass.
Option: TypeAlias = str | Mapping[str, Any] | Any
#: What is taken where no name is given.
DEFAULTS = {
    "env": "highway",
    "traffic": "idm_mobil",
    "observation": "lane_view_overlap",
    "mask": "none",
    "reward": "paper",
    "agent": "transfer",
    "init": "none",
    "collector": "single",
    "logger": "csv",
    "data": "scenes",
    "generator": "paper",
}
#: Keys of a command's root that a call cannot set: they only feed interpolations of the YAML files.
_OF_THE_YAML = {"generator"}


def option(group: str, chosen: Option, overrides: Mapping[str, Any] | None = None) -> Any:
    """The config dataclass of ``group`` that ``chosen`` means, with ``overrides`` on top.

    Args:
        group: ``env``, ``traffic``, ``observation``, ``reward`` ...
        chosen: see :data:`Option`; None: the group's default; for ``traffic`` also an import path or a class of
            your own.
        overrides: values by key, nested ones as mappings.

    Raises:
        UserError: no such option or key, a value of the wrong type or out of range.
    """
    if is_dataclass(chosen) and not isinstance(chosen, type):
        return typed(group, chosen, overrides or {})
    chosen = DEFAULTS[group] if chosen is None else chosen
    given = {"name": chosen} if isinstance(chosen, str) or inspect.isclass(chosen) else dict(_mapping(group, chosen))
    kind, own = _named(group, given.pop("name", DEFAULTS[group]))
    return typed(group, kind, {**own, **given, **(overrides or {})})


def _mapping(group: str, chosen: Any) -> Mapping[str, Any]:
    if not isinstance(chosen, Mapping):
        raise UserError(
            f"{group}={chosen!r}: expected a name, a mapping of its keys (with its name as 'name') or a config "
            "dataclass; give one of these."
        )
    return chosen


def _named(group: str, name: Any) -> tuple[Any, dict[str, Any]]:
    """Dataclass of an option and the values that its name stands for."""
    if group == "traffic" and inspect.isclass(name):
        return TrafficConfig, {"_target_": f"{name.__module__}.{name.__qualname__}"}
    if group == "traffic" and isinstance(name, str) and "." in name:
        return TrafficConfig, {"_target_": name}
    known = options_of(group)
    if name not in known:
        hint = did_you_mean(str(name), known)
        raise UserError(f"{group}={name}: no such option{hint}; choose one of {', '.join(known)}.")
    return option_of(group, name)


def typed(where: str, config: Any, values: Mapping[str, Any]) -> Any:
    """``config`` (a dataclass or one of its objects) with ``values``, types and ranges checked.

    Args:
        where: how its keys are called in messages, for instance ``env``; empty at the root.
        config: what the values go on top of.
        values: by key; nested ones as mappings.

    Raises:
        UserError: an unknown key, a value of the wrong type or out of range.
    """
    try:
        node = node_of(config)
        holder: Any = OmegaConf.create({where: node}) if where else node
        given = {name: _plain(value) for name, value in values.items()}
        merged: Any = OmegaConf.merge(holder, {where: given} if where else given)
        return made(merged.get(where) if where else merged, where)
    except CONFIG_ERRORS as error:
        told = sentence(error).replace("; run the command with --help to see all keys", "")
        raise UserError(told) from error


def _plain(value: Any) -> Any:
    """As the checks know it: paths as text, NumPy's and torch's numbers as Python's."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return node_of(value)
    if isinstance(value, Path):
        return str(value)
    return value.item() if hasattr(value, "item") else value


def command_config(kind: Any, parts: Mapping[str, Option], overrides: Mapping[str, Any]) -> Any:
    """Root config of a command.

    Args:
        kind: its dataclass, for instance :class:`ganlane.config.train.TrainConfig`.
        parts: options of its groups by group.
        overrides: keys of the root and, where ``env`` is among the groups, of the environment.
    """
    own = {known.name for known in fields(kind)} - set(parts) - _OF_THE_YAML
    of_env = {name: value for name, value in overrides.items() if name not in own} if "env" in parts else {}
    root = {name: value for name, value in overrides.items() if name not in of_env}
    chosen = {group: option(group, part, of_env if group == "env" else None) for group, part in parts.items()}
    return typed("", kind, {**root, **chosen})
