"""What every command has: seed, threads, device."""

from __future__ import annotations

from dataclasses import dataclass

from ganlane.errors import UserError
from ganlane.parameters.checks import at_least, between, check, one_of


@dataclass
class RunConfig:
    """Seed of all random numbers, torch's threads (0: chosen), device."""

    seed: int = 0
    threads: int = 0
    device: str = "cpu"

    def __post_init__(self) -> None:
        check(self, "", seed=between(0, 2**53), threads=at_least(0), device=one_of(("cpu", "cuda")))
        if self.device == "cuda":
            _require_cuda()


def _require_cuda() -> None:
    import torch

    if not torch.cuda.is_available():
        raise UserError("device=cuda: torch sees no CUDA device here; use device=cpu or install torch for CUDA.")


@dataclass
class GeneratorFile:
    """``generator.path``: weights for ``traffic=gan`` and ``gan_calibrated``; null takes the ones that ship."""

    path: str | None = None
