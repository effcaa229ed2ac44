"""Configuration shared by the commands: seed, threads, device, and the environment."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, TypeAlias

from ganlane.config.env import EnvConfig, check_reward
from ganlane.errors import UserError
from ganlane.parameters import DIFFERENT, CountOrZero, Record, Seed, between, one_of
from ganlane.parameters.observation import MaskParameters, ObservationConfig, RewardParameters

#: Number of environments in a batch.
Environments: TypeAlias = Annotated[int, between(1, 65536)]
#: A number of episodes; their results stay in memory.
Episodes: TypeAlias = Annotated[int, between(1, 10_000_000)]
#: Names without repetitions.
Names: TypeAlias = Annotated[list[str], DIFFERENT]
#: Columns of printed tables.
Columns: TypeAlias = Annotated[str, one_of(("auto", "all"))]


@dataclass
class RunConfig(Record):
    """Keys of every command.

    Attributes:
        seed: of all random numbers.
        threads: torch's threads; 0: one, which measured fastest (more are far slower where other work runs).
        device: cpu or cuda.
        columns: of printed tables; auto: as many as the terminal has room for; all.
    """

    seed: Seed = 0
    threads: CountOrZero = 0
    device: Annotated[str, one_of(("cpu", "cuda"))] = "cpu"
    columns: Columns = "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.device == "cuda" and not has_cuda():
            raise UserError("device=cuda: torch sees no CUDA device here; use device=cpu or install torch for CUDA.")


def has_cuda() -> bool:
    """Whether torch sees a CUDA device."""
    import torch

    return torch.cuda.is_available()


@dataclass
class GeneratorFile:
    """``generator``: weights of generated traffic.

    Attributes:
        path: weights for gan and gan_calibrated; null: the ones that ship.
    """

    path: str | None = None


@dataclass
class DrivingConfig(RunConfig):
    """Keys of every command that drives an environment.

    Attributes:
        generator: weights of generated traffic.
    """

    env: EnvConfig = field(default_factory=EnvConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    mask: MaskParameters = field(default_factory=MaskParameters)
    reward: RewardParameters = field(default_factory=RewardParameters)
    generator: GeneratorFile = field(default_factory=GeneratorFile)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_reward(self.env, self.reward)
