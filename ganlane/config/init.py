"""``init=...``: where the agent's weights come from."""

from __future__ import annotations

from dataclasses import dataclass

from ganlane.errors import UserError


@dataclass
class InitConfig:
    """``init=idm_ckpt``: start from a trained agent, by its name or its file."""

    path: str | None = "agent_idm"


@dataclass
class NoInitConfig(InitConfig):
    """``init=none``: start from random weights."""

    path: str | None = None

    def __post_init__(self) -> None:
        if self.path is not None:
            raise UserError(
                f"init.path={self.path}: init=none starts afresh; use init=idm_ckpt init.path={self.path}."
            )
