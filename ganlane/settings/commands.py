"""What the commands take: what all share; ``evaluate``, ``record``; environments."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from ganlane.errors import UserError
from ganlane.settings.env import EnvConfig, check_reward
from ganlane.settings.observation import MaskParameters, ObservationConfig, RewardParameters
from ganlane.settings.record import (
    DIFFERENT,
    CountOrZero,
    Record,
    Rule,
    Seed,
    Text,
    assign,
    between,
    key_names,
    make,
    one_of,
    plain,
)
from ganlane.settings.traffic import IdmMobilTrafficConfig, TrafficConfig, traffics_of

#: Number of environments in a batch.
Environments = Annotated[int, between(1, 65536)]
#: A number of episodes; their results stay in memory.
Episodes = Annotated[int, between(1, 10_000_000)]
#: Names without repetitions.
Names = Annotated[list[str], DIFFERENT]
#: Columns of printed tables.
Columns = Annotated[str, one_of(("auto", "all"))]
#: Family of episodes: of training, of model selection, of reported figures.
StreamName = Annotated[str, one_of(("train", "select", "report"))]
#: The same where nobody is trained: also the episodes of ganlane benchmark.
Measured = Annotated[str, one_of(("report", "select", "benchmark"))]


@dataclass(frozen=True)
class RunConfig(Record):
    """Keys of every command.

    Attributes:
        seed: of all random numbers.
        threads: of torch and of the native kernel; 0: one for torch, which measured fastest (more
            are far slower where other work runs), and every core for the kernel.
        device: cpu or cuda.
        columns: of printed tables; auto: as many as the terminal has room for; all.
    """

    # A run is the same on any machine but for rounding: threads and device change no episode.
    seed: Seed = 0
    threads: CountOrZero = 0
    device: Annotated[str, one_of(("cpu", "cuda"))] = "cpu"
    columns: Columns = "auto"

    def __post_init__(self) -> None:
        # Scenes and networks make tensors, so this comes first; without torch there are none.
        if "torch" in sys.modules:
            from ganlane.torch_settings import check_default_device

            check_default_device("cuda")  # no other one can be the environment's
        super().__post_init__()
        if self.device == "cuda":
            import torch  # takes seconds

            if not torch.cuda.is_available():
                raise UserError(
                    "device=cuda: torch sees no CUDA device here; use device=cpu or install torch "
                    "for CUDA."
                )


@dataclass(frozen=True)
class CpuConfig(RunConfig):
    """Keys of the commands that run on the CPU alone."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.device != "cpu":
            raise UserError(f"device={self.device}: this runs on the CPU alone; use device=cpu.")


@dataclass(frozen=True)
class DrivingConfig(RunConfig):
    """Keys of every command that drives an environment.

    Attributes:
        env: road, vehicles, first scenes, end of an episode.
        observation: what the agent perceives.
        mask: which actions it may choose.
        reward: section V.C.
    """

    env: EnvConfig = EnvConfig()
    observation: ObservationConfig = ObservationConfig()
    mask: MaskParameters = MaskParameters()
    reward: RewardParameters = RewardParameters()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_reward(self.env, self.reward)
        self.env.actions.check_mask(self.mask.form)


@dataclass(frozen=True)
class HighwayConfig(DrivingConfig):
    """Environments side by side: ``ganlane.make_env``, gymnasium, stable-baselines3.

    Attributes:
        traffic: who drives the other vehicles.
        num_envs: environments side by side.
        stream: family of the episodes: train, select or report (the episodes of ganlane evaluate).
    """

    traffic: TrafficConfig = IdmMobilTrafficConfig()
    num_envs: Environments = 1
    stream: StreamName = "train"


def with_env_keys(kind: type[Record], keys: Mapping[str, Any]) -> dict[str, Any]:
    """``keys`` of a call, those that ``kind`` does not have moved into its ``env``: ``lanes=4``."""
    names = {*key_names(kind), "experiment"}
    # What the command does not know is left for the environment to take or to refuse by name.
    of_env = {name: value for name, value in keys.items() if name not in names}
    if not of_env or "env" not in names:
        return dict(keys)
    result = {name: value for name, value in keys.items() if name in names}
    base = result.get("env", {})
    # The name of an option is short for a mapping.
    if isinstance(base, str):
        base = {"name": base}
    result["env"] = {**plain(base), **of_env}
    return result


def highways(**keys: Any) -> HighwayConfig:
    """The settings of environments from the arguments of a call.

    Raises:
        UserError: an unknown key or option, a value of the wrong type or out of range.
    """
    return make(HighwayConfig, with_env_keys(HighwayConfig, keys))


_DATASET = Rule(
    lambda name: re.fullmatch(r"(\w[\w-]*/)*\w[\w-]*-v\d+", name, re.ASCII) is not None,
    "a name such as highway/mobil-v0, its parts of letters, digits, - and _",
)


@dataclass(frozen=True)
class EvaluateConfig(DrivingConfig):
    """Agents x traffics, the same episodes for all of them.

    Attributes:
        agents: mobil, mobil_egoistic, keep_lane, random_legal, random; agent_idm and others that
            ship (agent_idm@1: its recipe trained with seed 1, agent_idm@all: with every seed there
            is); a checkpoint's path; the import path of a policy of your own. The normalised score
            needs mobil and random_legal.
        traffics: a list of options of the group traffic, of import paths of models of your own, or
            of options with changes, {name: gan, noise_scale: 0.5}; a mapping gives them names of
            your own.
        episodes: the episodes 0 to episodes - 1 of the seed and stream.
        num_envs: episodes driven side by side, at most.
        stream: select: the episodes kept for choosing among recipes, never for a reported figure;
            benchmark: those of ganlane benchmark.
    """

    # the matrix
    agents: Names = field(
        default_factory=lambda: ["mobil", "keep_lane", "random_legal", "agent_idm"]
    )
    traffics: dict[str, TrafficConfig] = field(
        default_factory=lambda: traffics_of(["idm", "idm_mobil", "gan", "gan_calibrated"], "")
    )
    # the same episodes for every pair; how many are driven at a time changes no result
    episodes: Episodes = 100
    num_envs: Environments = 512
    stream: Measured = "report"

    def __post_init__(self) -> None:
        # A list or a name becomes a mapping before its entries are checked.
        assign(self, traffics=traffics_of(self.traffics, "traffics"))
        super().__post_init__()


@dataclass(frozen=True)
class RecordConfig(HighwayConfig):
    """A driver's episodes as an offline dataset.

    Attributes:
        driver: agent=NAME says the same: a name, path or import path as in ganlane evaluate.
        episodes: the episodes 0 to episodes - 1 of the seed and stream.
        num_envs: episodes driven side by side, at most.
        out: folder of the datasets, Minari's MINARI_DATASETS_PATH; null: the run folder.
        dataset: the dataset's name; null: ganlane/TRAFFIC/DRIVER-v0.
    """

    # whose episodes
    driver: str = "mobil"
    episodes: Episodes = 100
    num_envs: Environments = 64
    # where they go
    out: Text | None = None
    dataset: Annotated[str, _DATASET] | None = None

    def dataset_name(self) -> str:
        """The dataset's name; by default made from traffic and driver."""
        if self.dataset is not None:
            return self.dataset
        parts = [
            re.sub(r"[^A-Za-z0-9_]+", "_", part).strip("_")
            for part in (self.traffic.label(), self.driver)
        ]
        return f"ganlane/{'/'.join(parts)}-v0"
