"""Every option's dataclass as Hydra's schema: the ConfigStore, OmegaConf's nodes, and back to
dataclasses.

A schema is called ``GROUP/NAME_schema``. The YAML of the same name under conf/ starts from it and
holds what differs from its defaults. A key or value that does not fit a schema becomes one
sentence.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from ganlane.config import commands, env, recordings, render, train
from ganlane.config.traffic import TRAFFICS
from ganlane.errors import ParameterError
from ganlane.files import conf_folder
from ganlane.parameters import did_you_mean
from ganlane.parameters.agent import RainbowConfig
from ganlane.parameters.generator import (
    CalibratedConfig,
    DataConfig,
    HighdDataConfig,
    NgsimDataConfig,
    PaperConfig,
)
from ganlane.parameters.observation import MaskParameters, ObservationConfig, RewardParameters

#: Group (empty at the root) to schema name to dataclass.
SCHEMAS: dict[str, dict[str, Any]] = {
    "": {
        "train": train.TrainConfig,
        "evaluate": commands.EvaluateConfig,
        "render": render.RenderConfig,
        "record": commands.RecordConfig,
        "bench": commands.BenchConfig,
        "prepare": recordings.PrepareConfig,
        "train_generator": recordings.TrainGeneratorConfig,
        "realism": recordings.RealismConfig,
        "reproduce": commands.ReproduceConfig,
    },
    "env": {
        "highway": env.EnvConfig,
        "dense": env.DenseEnvConfig,
        "cut_in": env.CutInEnvConfig,
        "stalled_car": env.StalledCarEnvConfig,
        "stop_and_go": env.StopAndGoEnvConfig,
        "blocked_lane": env.BlockedLaneEnvConfig,
        "scene": env.FileSceneEnvConfig,
    },
    "traffic": TRAFFICS,
    "init": {"none": train.NoInitConfig, "idm_ckpt": train.InitConfig},
    "agent": {"rainbow": RainbowConfig},
    "observation": {"observation": ObservationConfig},
    "mask": {"mask": MaskParameters},
    "reward": {"paper": RewardParameters},
    "collector": {
        "single": train.CollectorConfig,
    },
    "data": {"scenes": DataConfig, "ngsim": NgsimDataConfig, "highd": HighdDataConfig},
    "generator": {"paper": PaperConfig, "calibrated": CalibratedConfig},
    "logger": {"logger": train.LoggerConfig},
}
SUFFIX = "_schema"
#: OmegaConf's names of types, in words.
_TYPES = {
    "Integer": "a whole number",
    "Float": "a number",
    "bool": "true or false",
    "String": "a text",
}
HELP = "run the command with --help to see all keys"


def register(command: str) -> None:
    """Put the schemas of all options and of a command into the ConfigStore; may be called again."""
    store = ConfigStore.instance()
    for group, options in SCHEMAS.items():
        kept = store.repo.get(group, {}) if group else store.repo
        for name, schema in options.items():
            # Storing a schema takes milliseconds, that of a command up to 80, and a command
            # registers twice.
            if f"{name}{SUFFIX}.yaml" not in kept and (group or name == command):
                store.store(
                    group=group or None,
                    name=name + SUFFIX,
                    node=node_of(schema),
                    provider="ganlane",
                )
    OmegaConf.register_new_resolver("process_id", os.getpid, replace=True)


def options_of(group: str) -> list[str]:
    """Names of a group's options."""
    return sorted(path.stem for path in (conf_folder() / group).glob("*.yaml"))


def chosen_options(command: str) -> dict[str, str | None]:
    """Mounted group to the option that the command's YAML chooses, in its order."""
    listed: Any = OmegaConf.to_container(OmegaConf.load(conf_folder() / f"{command}.yaml"))
    return {
        mount: name
        for entry in listed["defaults"]
        if isinstance(entry, dict)
        for mount, name in entry.items()
    }


def option_of(group: str, name: str) -> tuple[Any, dict[str, Any]]:
    """Dataclass of an option, and the values that differ from its defaults."""
    values: Any = OmegaConf.to_container(OmegaConf.load(conf_folder() / group / f"{name}.yaml"))
    base = values.pop("defaults")[0]
    if base.endswith(SUFFIX):
        return SCHEMAS[group][base.removesuffix(SUFFIX)], values
    kind, inherited = option_of(group, base)
    return kind, {**inherited, **values}


def node_of(config: Any) -> DictConfig:
    """A dataclass or an instance of one as a writable node, even if the dataclass is frozen."""
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
    """The dataclass of ``node``, ranges checked.

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
    """Key of the innermost part of ``node`` (its own key is ``key``) that is invalid."""
    for name in node:
        child = node._get_node(name)
        if isinstance(child, DictConfig) and not child._is_none():
            try:
                OmegaConf.to_object(child)
            except ParameterError:
                return _refused(child, f"{key}.{name!s}" if key else str(name))
    return key


def value_sentence(error: OmegaConfBaseException) -> str:
    """The sentence for an unknown key, a value of the wrong type, or another error of OmegaConf."""
    key = (error.full_key or str(error.key or "")).removeprefix(".")
    if isinstance(error, (ConfigKeyError, ConfigAttributeError)):
        if key.rpartition(".")[0].endswith(".parameters"):
            return f"{key}: to be added with +; write +{key}=VALUE."
        known = (
            sorted(map(str, error.parent_node.keys()))
            if OmegaConf.is_dict(error.parent_node)
            else []
        )
        return unknown_key(key, [other for other in known if other != "hydra"])
    text = one_line(error.msg or str(error))
    value = re.search(r"[Vv]alue '(.*?)' ", text)
    wanted = re.search(r"could not be converted to (\w+)", text) or re.search(
        r"not a valid (bool)", text
    )
    if wanted and value and wanted[1] in _TYPES:
        typed = {"None": "null", "True": "true", "False": "false"}.get(value[1], value[1])
        return f"{key}={typed}: expected {_TYPES[wanted[1]]}; {HELP}."
    if "not Optional" in text or "non-optional" in text:
        return f"{key}=null: a value is needed; {HELP}."
    if "ListConfig" in text:
        return f"{key}: expected a list in brackets, for instance {key}=[...]; {HELP}."
    if "not a subclass" in text or text.startswith("Cannot assign"):
        return f"{key}: holds keys of its own; give {key}.NAME=VALUE; {HELP}."
    return f"{key}: {text.partition(' full_key')[0]}; {HELP}."


def one_line(error: BaseException | str) -> str:
    """The text without line breaks and final full stop."""
    return re.sub(r"\s+", " ", str(error)).strip().rstrip(".")


def unknown_key(key: str, known: Sequence[str], of: str | None = None) -> str:
    """The sentence for a ``key`` that is not ``known``; ``of`` replaces the name of its parent."""
    parent, _, name = key.rpartition(".")
    where = of or (f"{parent} has" if parent else "known are")
    listed = f"; {where} {', '.join(known)}" if known else f"; {HELP}"
    return f"{key}: no such key{did_you_mean(name, known)}{listed}."
