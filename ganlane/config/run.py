"""What the commands share: seed, threads, device, and the file of the generated traffic."""

from __future__ import annotations

from dataclasses import dataclass

from ganlane.errors import UserError
from ganlane.parameters.checks import Rule, at_least, between, check, one_of

#: A list of names without repetitions.
NAMES = Rule(lambda names: len(names) > 0 and len(set(names)) == len(names), "a list of different names, not empty")
#: A number of episodes; their results stay in memory.
EPISODES = between(1, 10_000_000)
#: Of printed tables.
COLUMNS = ("auto", "all")


@dataclass
class RunConfig:
    """What every command has.

    Attributes:
        seed: of all random numbers.
        threads: torch's threads; 0: one, which measured fastest (more are far slower where other work runs).
        device: cpu or cuda.
        columns: of printed tables; auto: as many as the terminal has room for; all.
    """

    seed: int = 0
    threads: int = 0
    device: str = "cpu"
    columns: str = "auto"

    def __post_init__(self) -> None:
        check(self, seed=between(0, 2**53), threads=at_least(0), device=one_of(("cpu", "cuda")))
        check(self, columns=one_of(COLUMNS))
        if self.device == "cuda" and not has_cuda():
            raise UserError("device=cuda: torch sees no CUDA device here; use device=cpu or install torch for CUDA.")


def has_cuda() -> bool:
    """Whether torch sees a CUDA device."""
    import torch

    return torch.cuda.is_available()


@dataclass
class GeneratorFile:
    """``generator``: which weights generated traffic drives with.

    Attributes:
        path: weights for gan and gan_calibrated; null: the ones that ship.
    """

    path: str | None = None
