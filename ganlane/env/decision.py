"""One decision of the ego, driven through its physics steps."""

from __future__ import annotations

from collections.abc import Callable

from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.env.frozen import Frozen
from ganlane.env.physics import Physics, Substep
from ganlane.env.rules import Rules
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
        self,
        state: TensorDictBase,
        at: Substep,
        key: Tensor,
        recorder: Recorder | None = None,
        substeps: int | None = None,
    ) -> tuple[Substep, TensorDictBase]:
        """All physics steps of a decision from ``at``, and the traffic's memory after it.

        Args:
            state: where the decision began.
            at: its first moment.
            key: of the episodes, [N] int64.
            recorder: told of every step.
            substeps: other than the decision period has.
        """
        memory, start = memory_of(state), at.step
        counters = {keys.SEED: state.get(keys.SEED), keys.EPISODE: state.get(keys.EPISODE), keys.EPISODE_KEY: key}
        frozen = Frozen()
        if asking_is_free(at.running):
            frozen.note(~at.running, memory)
        for count in range(self.rules.episode.substeps() if substeps is None else substeps):
            running = at.running
            if known_false(running.any()):
                break
            # The traffic's clock goes on in rows that ended: had it stopped there at a moment of decision, the
            # traffic would take its drivers to be deciding for the rest of the time, for nothing.
            at, memory = self._step(at, memory, {**counters, keys.STEP: start + count}, frozen)
            if recorder is not None:
                recorder(at.vehicles, running)
        return at, frozen.put_back(memory)

    def _step(
        self, at: Substep, memory: TensorDictBase, counters: dict[str, Tensor], frozen: Frozen
    ) -> tuple[Substep, TensorDictBase]:
        """One physics step, and the traffic's memory after it. Rows that ended stay as they are.

        What the traffic remembers of them is put aside in ``frozen``, or on a GPU, where finding them would stall,
        kept in every step.
        """
        size = memory.batch_size
        vehicles = TensorDict._new_unsafe(at.vehicles.as_dict(), batch_size=size)
        seen = TensorDict._new_unsafe({keys.VEHICLES: vehicles, keys.TRAFFIC: memory, **counters}, batch_size=size)
        after = self.traffic(seen)
        everybody = known_false((~at.running).any())
        now = self.physics.advance(self.rules, at, Vehicles.of(after.get(keys.MOVED)), everybody)
        kept = after.get(keys.TRAFFIC)
        if not asking_is_free(at.running):
            return now, where(at.running, kept, memory)
        frozen.note(at.running & ~now.running, kept)
        return now, kept


def asking_is_free(flag: Tensor) -> bool:
    """Whether Python may look at ``flag``: on a CPU that costs nothing and may spare work; a GPU would stall."""
    return flag.device.type == "cpu"


def known_false(flag: Tensor) -> bool:
    """Whether ``flag`` is known to be false."""
    return asking_is_free(flag) and not bool(flag)
