"""Everything the rest of a run follows from: agent, window, carrier, counters. It can be saved and restored."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from ganlane.agents import Rainbow
from ganlane.errors import UserError
from ganlane.training.checkpoints import load_checkpoint, pack, unpack
from ganlane.training.meter import Meter


class Run:
    """State of a run of ``agent`` in ``env``, batch [N].

    ``carrier`` is the TensorDict that takes the environments' state from step to step; ``owed`` counts the decisions
    not yet paid for by an update; ``best`` is the best evaluation so far.
    """

    def __init__(self, env: EnvBase, agent: Rainbow) -> None:
        self.env, self.agent = env, agent
        self.environments = env.batch_size.numel()
        self.window = agent.window()
        self.meter = Meter(self.environments, agent.network.config.actions, agent.config.gamma, agent.device)
        self.carrier: TensorDictBase = env.reset()
        self.decisions, self.owed = 0, 0
        self.best: float | None = None
        self._before_s, self._started_s = 0.0, time.monotonic()

    @property
    def wall_s(self) -> float:
        """Seconds of training, earlier stretches included."""
        return self._before_s + time.monotonic() - self._started_s

    def passed(self, every: int) -> bool:
        """Whether the last step passed a multiple of ``every`` decisions; never, for 0."""
        return every > 0 and self.decisions // every > (self.decisions - self.environments) // every

    def state_dict(self, with_replay: bool = True) -> dict[str, Any]:
        """Tensors and plain data; without the replay buffer it is small, but a resumed run is not bit-exact."""
        counters = {"decisions": self.decisions, "owed": self.owed, "wall_s": self.wall_s, "best": self.best}
        return {
            "agent": self.agent.state_dict(with_replay),
            "window": self.window.state_dict(),
            "carrier": pack(self.carrier),
            "meter": self.meter.state_dict(),
            "counters": counters,
        }

    def restore(self, path: str | Path) -> bool:
        """Go on from the checkpoint of a run with as many environments and the same agent.

        Returns:
            Whether the replay buffer was in it, so that the rest of the run is the one it would have been.

        Raises:
            UserError: unreadable, or of another run.
        """
        state = load_checkpoint(path, self.agent.device)
        carrier, expected = unpack(state["carrier"]), self.carrier.batch_size
        if carrier.batch_size != expected:
            raise UserError(
                f"resume={path}: saved with environments of shape {list(carrier.batch_size)}, this run has "
                f"{list(expected)}; use the same number."
            )
        self.agent.load_state_dict(state["agent"])
        self.window.load_state_dict(state["window"])
        self.meter.load_state_dict(state["meter"])
        self.carrier, counters = carrier, state["counters"]
        self.decisions, self.owed, self.best = (counters[name] for name in ("decisions", "owed", "best"))
        self._before_s = counters["wall_s"]
        return state["agent"]["replay"] is not None
