"""Every option's schema in Hydra's ConfigStore, as ``GROUP/NAME_schema``; the YAML in conf/ holds the values."""

from __future__ import annotations

import os
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from ganlane.config.bench import BenchConfig
from ganlane.config.collector import CollectorConfig, MultiCollectorConfig, RayCollectorConfig
from ganlane.config.data import DataConfig, HighdDataConfig, NgsimDataConfig
from ganlane.config.env import DenseEnvConfig, EnvConfig
from ganlane.config.evaluate import EvaluateConfig
from ganlane.config.generator import CalibratedGeneratorConfig, PaperGeneratorConfig
from ganlane.config.init import InitConfig, NoInitConfig
from ganlane.config.logger import LoggerConfig, TensorBoardLoggerConfig, WandbLoggerConfig
from ganlane.config.nodes import node_of
from ganlane.config.observation import ObservationConfig
from ganlane.config.prepare import PrepareConfig
from ganlane.config.realism import RealismConfig
from ganlane.config.render import RenderConfig
from ganlane.config.scenarios import (
    BlockedLaneEnvConfig,
    CutInEnvConfig,
    FileSceneEnvConfig,
    StalledCarEnvConfig,
    StopAndGoEnvConfig,
)
from ganlane.config.traffic import (
    GanCalibratedTrafficConfig,
    GanTrafficConfig,
    IdmMobilTrafficConfig,
    IdmTrafficConfig,
)
from ganlane.config.traffic_faults import IdmFaultsTrafficConfig
from ganlane.config.traffic_foreign import HighwayEnvTrafficConfig, SumoTrafficConfig
from ganlane.config.traffic_mixed import MixedTrafficConfig
from ganlane.config.traffic_random import IdmRandomTrafficConfig
from ganlane.config.traffic_replay import ReplayTrafficConfig
from ganlane.config.train import TrainConfig
from ganlane.config.train_generator import TrainGeneratorConfig
from ganlane.parameters.agent import RainbowConfig
from ganlane.parameters.observation import MaskParameters
from ganlane.parameters.reward import RewardParameters

#: Group (empty at the root) to schema name to dataclass.
SCHEMAS: dict[str, dict[str, Any]] = {
    "": {
        "train": TrainConfig,
        "evaluate": EvaluateConfig,
        "render": RenderConfig,
        "bench": BenchConfig,
        "prepare": PrepareConfig,
        "train_generator": TrainGeneratorConfig,
        "realism": RealismConfig,
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
    "traffic": {
        "idm": IdmTrafficConfig,
        "idm_mobil": IdmMobilTrafficConfig,
        "gan": GanTrafficConfig,
        "gan_calibrated": GanCalibratedTrafficConfig,
        "idm_faults": IdmFaultsTrafficConfig,
        "idm_random": IdmRandomTrafficConfig,
        "mixed": MixedTrafficConfig,
        "replay": ReplayTrafficConfig,
        "sumo": SumoTrafficConfig,
        "highway_env": HighwayEnvTrafficConfig,
    },
    "init": {"none": NoInitConfig, "idm_ckpt": InitConfig},
    "agent": {"rainbow": RainbowConfig},
    "observation": {"observation": ObservationConfig},
    "mask": {"mask": MaskParameters},
    "reward": {"paper": RewardParameters},
    "collector": {"single": CollectorConfig, "multi": MultiCollectorConfig, "ray": RayCollectorConfig},
    "data": {"scenes": DataConfig, "ngsim": NgsimDataConfig, "highd": HighdDataConfig},
    "generator": {"paper": PaperGeneratorConfig, "calibrated": CalibratedGeneratorConfig},
    "logger": {"csv": LoggerConfig, "tensorboard": TensorBoardLoggerConfig, "wandb": WandbLoggerConfig},
}
SUFFIX = "_schema"


def register() -> None:
    """Fill the ConfigStore; again does no harm."""
    store = ConfigStore.instance()
    for group, options in SCHEMAS.items():
        kept = store.repo.get(group, {}) if group else store.repo
        for name, schema in options.items():
            # Storing one takes OmegaConf milliseconds, and a command comes here twice.
            if f"{name}{SUFFIX}.yaml" not in kept:
                store.store(group=group or None, name=name + SUFFIX, node=node_of(schema), provider="ganlane")
    OmegaConf.register_new_resolver("process_id", os.getpid, replace=True)
