"""Root of ``ganlane prepare``."""

from __future__ import annotations

from dataclasses import dataclass, field

from ganlane.config.data import DataConfig
from ganlane.config.run import RunConfig
from ganlane.errors import UserError
from ganlane.parameters.checks import at_least, check, optional


@dataclass
class PrepareConfig(RunConfig):
    """Recordings, and where their Parquet goes."""

    data: DataConfig = field(default_factory=DataConfig)
    out: str | None = None
    scene_s: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "", scene_s=optional(at_least(1)))
        if self.device != "cpu":
            raise UserError(f"device={self.device}: recordings are prepared on the CPU; use device=cpu.")
        if self.data.format != "scenes" and self.data.path is None:
            raise UserError(f"data={self.data.format}: which file is missing; give data.path=FILE.")
