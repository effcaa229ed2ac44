"""``collector=...``: how experience is collected."""

from __future__ import annotations

from dataclasses import dataclass

from ganlane.config.checks import between, check


@dataclass
class CollectorConfig:
    """``collector=single``: one process steps ``num_envs`` environments side by side."""

    num_envs: int = 128

    def __post_init__(self) -> None:
        check(self, "collector", num_envs=between(1, 65536))
