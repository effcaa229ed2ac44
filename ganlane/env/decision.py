"""One decision of the ego, driven through its physics steps."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.env.physics import Physics, Rules, Substep
from ganlane.env.state import where
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import TrafficModule, memory_of

#: Called after every physics step with the vehicles and the rows [N] that were running in it.
Recorder = Callable[[Vehicles, Tensor], None]


class Decision:
    """Drives the rows of a batch from one decision to the next.

    Args:
        traffic: moves the other vehicles.
        physics: moves the ego and says what happened, by ``rules``.
    """

    def __init__(self, traffic: TrafficModule, physics: Physics, rules: Rules) -> None:
        self.traffic, self.physics, self.rules = traffic, physics, rules

    def drive(
        self, state: TensorDictBase, at: Substep, key: Tensor, recorder: Recorder | None = None
    ) -> tuple[Substep, TensorDictBase]:
        """All physics steps of a decision from ``at``, and the traffic's memory after it; ``key`` [N] of the episodes."""
        view, start = self._view(state, key), at.step
        for count in range(self.rules.episode.substeps()):
            running = at.running
            if _known(running) and not bool(running.any()):
                break
            at = self._step(view, at, start + count)
            if recorder is not None:
                recorder(at.vehicles, running)
        return at, view.get(keys.TRAFFIC)

    def _view(self, state: TensorDictBase, key: Tensor) -> TensorDictBase:
        """What a traffic module reads, but for the vehicles."""
        counters = {name: state.get(name) for name in (keys.SEED, keys.EPISODE)}
        fields = {keys.TRAFFIC: memory_of(state), keys.EPISODE_KEY: key, **counters}
        return TensorDict._new_unsafe(fields, batch_size=state.batch_size)

    def _step(self, view: TensorDictBase, at: Substep, step: Tensor) -> Substep:
        """One physics step; ``view`` takes the traffic's new memory. Rows that ended stay as they are.

        The traffic's clock ``step`` [N] goes on in rows that ended: had it stopped there at a moment of decision, the
        traffic would take all of its drivers to be deciding for the rest of the time, for nothing.
        """
        view.set(keys.VEHICLES, _as_tensordict(at.vehicles, view))
        view.set(keys.STEP, step)
        before = view.get(keys.TRAFFIC)
        self.traffic(view)
        everybody = _known(at.running) and bool(at.running.all())
        if not everybody:
            view.set(keys.TRAFFIC, where(at.running, view.get(keys.TRAFFIC), before))
        return self.physics.advance(self.rules, at, Vehicles.of(view.get(keys.MOVED)), everybody)


def _as_tensordict(vehicles: Vehicles, like: TensorDictBase) -> TensorDictBase:
    return TensorDict._new_unsafe(vehicles.as_dict(), batch_size=like.batch_size)


def _known(mask: Tensor) -> bool:
    """Whether a mask may be asked for: on a CPU that is free and spares work; on a GPU it would stall the queue."""
    return mask.device.type == "cpu"
