"""``init=...``: where the agent's weights come from, and what else comes with them."""

from __future__ import annotations

from dataclasses import dataclass

from ganlane.errors import UserError
from ganlane.parameters.checks import check, one_of

#: Whose support of returns: that of the run's own ``agent``, or that of the trained agent.
SUPPORTS = ("run", "trained")


@dataclass
class InitConfig:
    """``init=idm_ckpt``: start from a trained agent.

    ``path`` is a shipped agent's name, an agent's ``.safetensors`` file, or a training run's folder or ``last.pt``;
    ``support=trained`` takes over its ``atoms``, ``v_min`` and ``v_max``, ``optimizer`` Adam's moments.
    """

    path: str | None = "agent_idm"
    support: str = "run"
    optimizer: bool = False

    def __post_init__(self) -> None:
        check(self, "init", support=one_of(SUPPORTS))
        asked = "init.optimizer=true" if self.optimizer else "init.support=trained"
        if self.path is None and (self.optimizer or self.support == "trained"):
            raise UserError(
                f"{asked}: of which agent? give init=idm_ckpt, and init.path=PATH unless the shipped one."
            )


@dataclass
class NoInitConfig(InitConfig):
    """``init=none``: start from random weights."""

    path: str | None = None

    def __post_init__(self) -> None:
        if self.path is not None:
            raise UserError(
                f"init.path={self.path}: init=none starts afresh; use init=idm_ckpt init.path={self.path}."
            )
        super().__post_init__()
