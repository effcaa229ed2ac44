"""Every option's dataclass as Hydra's schema: the ConfigStore, OmegaConf's nodes, and back to dataclasses.

A schema is called ``GROUP/NAME_schema``. The YAML of the same name under conf/ starts from it and holds what differs
from its defaults.
"""

from __future__ import annotations

import os
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from ganlane.config.bench import BenchConfig
from ganlane.config.env import DenseEnvConfig, EnvConfig
from ganlane.config.evaluate import EvaluateConfig, RecordConfig, ReproduceConfig
from ganlane.config.recordings import PrepareConfig, RealismConfig, TrainGeneratorConfig
from ganlane.config.render import RenderConfig
from ganlane.config.scenarios import (
    BlockedLaneEnvConfig,
    CutInEnvConfig,
    FileSceneEnvConfig,
    StalledCarEnvConfig,
    StopAndGoEnvConfig,
)
from ganlane.config.traffic import TRAFFICS
from ganlane.config.train import (
    CollectorConfig,
    InitConfig,
    LoggerConfig,
    MultiCollectorConfig,
    NoInitConfig,
    OverlapCollectorConfig,
    RayCollectorConfig,
    TrainConfig,
)
from ganlane.errors import ParameterError
from ganlane.files import conf_folder
from ganlane.parameters.agent import RainbowConfig
from ganlane.parameters.generator import CalibratedConfig, DataConfig, HighdDataConfig, NgsimDataConfig, PaperConfig
from ganlane.parameters.observation import MaskParameters, ObservationConfig, RewardParameters

#: Group (empty at the root) to schema name to dataclass.
SCHEMAS: dict[str, dict[str, Any]] = {
    "": {
        "train": TrainConfig,
        "evaluate": EvaluateConfig,
        "render": RenderConfig,
        "record": RecordConfig,
        "bench": BenchConfig,
        "prepare": PrepareConfig,
        "train_generator": TrainGeneratorConfig,
        "realism": RealismConfig,
        "reproduce": ReproduceConfig,
    },
    "env": {
        "highway": EnvConfig,
        "dense": DenseEnvConfig,
        "cut_in": CutInEnvConfig,
        "stalled_car": StalledCarEnvConfig,
        "stop_and_go": StopAndGoEnvConfig,
        "blocked_lane": BlockedLaneEnvConfig,
        "scene": FileSceneEnvConfig,
    },
    "traffic": {**TRAFFICS},
    "init": {"none": NoInitConfig, "idm_ckpt": InitConfig},
    "agent": {"rainbow": RainbowConfig},
    "observation": {"observation": ObservationConfig},
    "mask": {"mask": MaskParameters},
    "reward": {"paper": RewardParameters},
    "collector": {
        "single": CollectorConfig,
        "overlap": OverlapCollectorConfig,
        "multi": MultiCollectorConfig,
        "ray": RayCollectorConfig,
    },
    "data": {"scenes": DataConfig, "ngsim": NgsimDataConfig, "highd": HighdDataConfig},
    "generator": {"paper": PaperConfig, "calibrated": CalibratedConfig},
    "logger": {"logger": LoggerConfig},
}
SUFFIX = "_schema"


def register(command: str) -> None:
    """Put the schemas of all options and of a command into the ConfigStore; may be called again."""
    store = ConfigStore.instance()
    for group, options in SCHEMAS.items():
        kept = store.repo.get(group, {}) if group else store.repo
        for name, schema in options.items():
            # Storing a schema takes milliseconds, that of a command up to 80, and a command registers twice.
            if f"{name}{SUFFIX}.yaml" not in kept and (group or name == command):
                store.store(group=group or None, name=name + SUFFIX, node=node_of(schema), provider="ganlane")
    OmegaConf.register_new_resolver("process_id", os.getpid, replace=True)


def options_of(group: str) -> list[str]:
    """Names of a group's options."""
    return sorted(path.stem for path in (conf_folder() / group).glob("*.yaml"))


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
