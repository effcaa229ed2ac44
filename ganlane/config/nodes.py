"""Dataclasses as nodes of OmegaConf, and back."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig, OmegaConf

from ganlane.errors import ParameterError


def node_of(config: Any) -> DictConfig:
    """A dataclass, or one of its objects, as a node whose values can be set, those of frozen ones too."""
    node: DictConfig = OmegaConf.structured(config)
    _unlock(node)
    return node


def _unlock(node: Any) -> None:
    if isinstance(node, DictConfig):
        OmegaConf.set_readonly(node, None)
        if not node._is_none() and not node._is_missing():
            for name in node:
                _unlock(node._get_node(name))


def made(node: Any, where: str = "") -> Any:
    """The dataclass that ``node`` stands for, ranges checked.

    Args:
        node: a node with a dataclass as its type.
        where: its key; empty at the root.

    Raises:
        ParameterError: of a value out of range, by its whole key.
        omegaconf.errors.OmegaConfBaseException: a value is of the wrong type.
    """
    try:
        return OmegaConf.to_object(node)
    except ParameterError as error:
        if error.where:
            raise
        raise error.below(_refused(node, where)) from error


def _refused(node: DictConfig, key: str) -> str:
    """Key of the innermost part of ``node``, itself called ``key``, that cannot be made."""
    for name in node:
        child = node._get_node(name)
        if isinstance(child, DictConfig) and not child._is_none():
            try:
                OmegaConf.to_object(child)
            except ParameterError:
                return _refused(child, f"{key}.{name!s}" if key else str(name))
    return key
