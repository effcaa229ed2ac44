"""``collector=...``: how experience is collected."""

from __future__ import annotations

from dataclasses import dataclass

from ganlane.parameters.checks import at_least, between, check, optional, text


@dataclass
class CollectorConfig:
    """``collector=single``: one process steps ``num_envs`` environments side by side."""

    num_envs: int = 512

    def __post_init__(self) -> None:
        check(self, "collector", num_envs=between(1, 65536))

    @property
    def environments(self) -> int:
        """Decisions per step of the loop, over all processes."""
        return self.num_envs


@dataclass
class MultiCollectorConfig(CollectorConfig):
    """``collector=multi``: ``workers`` processes with ``num_envs`` environments each."""

    num_envs: int = 64
    workers: int = 2
    weights_every: int = 1024

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "collector", workers=between(1, 1024), weights_every=at_least(1))

    @property
    def environments(self) -> int:
        """Decisions per step of the loop, over all workers."""
        return self.workers * self.num_envs


@dataclass
class RayCollectorConfig(MultiCollectorConfig):
    """``collector=ray``: the same on a Ray cluster."""

    address: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "collector", address=optional(text()))
