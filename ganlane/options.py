"""Config dataclasses from names, mappings and keyword arguments, with the checks of the command
line.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeAlias

from omegaconf import DictConfig, OmegaConf

from ganlane.config.command_line import VALUE_ERRORS, sentence
from ganlane.config.schemas import (
    HELP,
    SCHEMAS,
    chosen_options,
    made,
    node_of,
    option_of,
    options_of,
)
from ganlane.config.traffic import TrafficConfig
from ganlane.errors import UserError
from ganlane.parameters import did_you_mean

#: An option's name; a mapping of its keys, with its name as ``name``; or its config dataclass.
Option: TypeAlias = str | Mapping[str, Any] | Any
#: Options that None and mappings without a name mean outside a command; each command's YAML has its
#: own defaults.
DEFAULTS = {
    "env": "highway",
    "traffic": "idm_mobil",
    "observation": "lane_view_overlap",
    "mask": "none",
    "reward": "paper",
}


def option(
    group: str,
    chosen: Option,
    overrides: Mapping[str, Any] | None = None,
    default: str | None = None,
) -> Any:
    """The config dataclass of ``group`` that ``chosen`` names, with ``overrides`` on top.

    Args:
        group: ``env``, ``traffic``, ``observation``, ``reward`` ...
        chosen: see :data:`Option`; None: ``default``; for ``traffic`` also an import path or a
            class.
        overrides: values by key, nested ones as mappings.
        default: name of the option where none is given; None: that of :data:`DEFAULTS`.

    Raises:
        UserError: no such option or key, a value of the wrong type or out of range, or torch's
            default device cannot be used.
    """
    # otherwise its default device is unchanged, and importing it takes seconds
    if "torch" in sys.modules:
        from ganlane.torch_settings import check_default_device

        check_default_device("cuda")  # no other one can be the environment's
    if is_dataclass(chosen) and not isinstance(chosen, type):
        return typed(group, chosen, overrides or {})
    if chosen is None or isinstance(chosen, str) or inspect.isclass(chosen):
        values = {} if chosen is None else {"name": chosen}
    elif isinstance(chosen, Mapping):
        values = dict(chosen)
    else:
        raise UserError(
            f"{group}={chosen!r}: expected a name, a mapping of its keys (with its name as 'name') or a config "
            "dataclass; give one of these."
        )
    name = values.pop("name", default or DEFAULTS[group])
    if group == "traffic" and inspect.isclass(name):
        name = f"{name.__module__}.{name.__qualname__}"
    if group == "traffic" and isinstance(name, str) and "." in name:
        kind, own = TrafficConfig, {"_target_": name}
    elif name in (known := options_of(group)):
        kind, own = option_of(group, name)
    else:
        hint = did_you_mean(str(name), known)
        raise UserError(f"{group}={name}: no such option{hint}; choose one of {', '.join(known)}.")
    return typed(group, kind, {**own, **values, **(overrides or {})})


def typed(where: str, config: Any, values: Mapping[str, Any]) -> Any:
    """``config`` (a dataclass or one of its objects) with ``values``, types and ranges checked.

    Args:
        where: key of the config in messages, for instance ``env``; empty at the root.
        config: default values.
        values: by key; nested ones as mappings.

    Raises:
        UserError: an unknown key, a value of the wrong type or out of range.
    """
    try:
        node = node_of(config)
        given = {name: _plain(value) for name, value in values.items()}
        _add_entries(node, given)
        holder: Any = OmegaConf.create({where: node}) if where else node
        merged: Any = OmegaConf.merge(holder, {where: given} if where else given)
        return made(merged.get(where) if where else merged, where)
    except VALUE_ERRORS as error:
        raise UserError(sentence(error).replace(f"; {HELP}", "")) from error


def _add_entries(node: Any, values: Mapping[str, Any]) -> None:
    """Give ``node`` the entries of ``values`` that a mapping of dataclasses in it lacks.

    OmegaConf itself would make entries of frozen dataclasses read-only and then refuse their
    values.
    """
    for name, value in values.items():
        if (
            not isinstance(value, (Mapping, DictConfig))
            or not isinstance(node, DictConfig)
            or node._is_none()
        ):
            continue
        if name in node:
            _add_entries(node._get_node(name), value)
        elif is_dataclass(kind := node._metadata.element_type):
            node[name] = value if isinstance(value, DictConfig) else node_of(kind)


def _plain(value: Any) -> Any:
    """``value`` in types that OmegaConf knows.

    Paths as text, NumPy's and torch's numbers and arrays as Python's.
    """
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return node_of(value)
    if isinstance(value, Path):
        return str(value)
    return _plain(value.tolist()) if hasattr(value, "tolist") else value


def command_config(command: str, keys: Mapping[str, Any]) -> Any:
    """Root config of a command.

    Args:
        command: ``train``, ``evaluate`` ...
        keys: options by group, keys of the root and, where the command has an environment, keys of
            that.

    Raises:
        UserError: see :func:`option`.
    """
    chosen = chosen_options(command).items()
    kind, defaults = (
        SCHEMAS[""][command],
        {group: name for group, name in chosen if name and "@" not in group},
    )
    # Outside train_generator, 'generator' only feeds interpolations of the YAML files, which a call
    # does not read.
    own = {known.name for known in fields(kind)} - ({"generator"} - set(defaults))
    of_env = (
        {name: value for name, value in keys.items() if name not in own}
        if "env" in defaults
        else {}
    )
    values = {name: value for name, value in keys.items() if name not in of_env}
    for group, name in defaults.items():
        values[group] = option(group, values.get(group), of_env if group == "env" else None, name)
    return typed("", kind, values)
