"""One decision of the ego, simulated through its physics steps."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.env.physics import Physics, Rules, Substep
from ganlane.env.state import where
from ganlane.sim.state import Vehicles
from ganlane.traffic.base import TrafficModule, memory_of

#: Called after every physics step with the vehicles and the rows [N] that were running in it.
Recorder = Callable[[Vehicles, Tensor], None]


class EndedRows:
    """The traffic's memory of the rows that end within a decision, kept as it was when they ended.

    Meanwhile the traffic still computes these rows, in vain. Restoring their memory in every physics step would
    copy that of all rows each time, and generated traffic's is large.
    """

    def __init__(self) -> None:
        self.rows: list[Tensor] = []
        self.memories: list[TensorDictBase] = []

    def keep(self, ended: Tensor, memory: TensorDictBase) -> None:
        """Keep the ``memory`` of the rows [N] that have just ``ended``."""
        if ended.any():
            rows = ended.nonzero()[:, 0]
            self.rows.append(rows)
            # TorchRL drops empty parts between decisions, so the first moment's would differ from later ones.
            self.memories.append(memory[rows].filter_empty_())

    def restore(self, memory: TensorDictBase) -> TensorDictBase:
        """``memory`` with the kept rows as they were; its tensors are not written to."""
        if not self.rows or memory.is_empty():
            return memory
        return _with_rows(memory, torch.cat(self.rows), torch.cat(self.memories))  # type: ignore[arg-type]


def _with_rows(memory: TensorDictBase, rows: Tensor, other: TensorDictBase) -> TensorDict:
    """``memory`` with its ``rows`` replaced by ``other`` [R], leaf by leaf."""

    def replaced(name: str, value: Tensor | TensorDictBase) -> Tensor | TensorDictBase:
        if isinstance(value, TensorDictBase):
            return value if value.is_empty() else _with_rows(value, rows, other.get(name))
        return value.index_copy(0, rows, other.get(name))

    kept = {name: replaced(name, value) for name, value in memory.items()}
    return TensorDict._new_unsafe(kept, batch_size=memory.batch_size)


def run_decision(
    traffic: TrafficModule,
    physics: Physics,
    rules: Rules,
    state: TensorDictBase,
    start: Substep,
    key: Tensor,
    recorder: Recorder | None = None,
    substeps: int | None = None,
) -> tuple[Substep, TensorDictBase]:
    """All physics steps of a decision: where they lead, and the traffic's memory after it.

    Rows that end stay as they are. Their memory is put aside, or on a GPU, where finding them would wait for the
    queue, kept in every step.

    Args:
        traffic: moves the other vehicles.
        physics: moves the ego and finds the events, by ``rules``.
        rules: of the episodes.
        state: at the beginning of the decision.
        start: its first moment.
        key: of the episodes, [N] int64.
        recorder: called after every step.
        substeps: number of physics steps; None: those of the decision period.
    """
    memory, now, ended = memory_of(state), start, EndedRows()
    counters = {keys.SEED: state.get(keys.SEED), keys.EPISODE: state.get(keys.EPISODE), keys.EPISODE_KEY: key}
    size, can_read = memory.batch_size, readable(now.running)
    if can_read:
        ended.keep(~now.running, memory)
    for count in range(rules.episode.substeps() if substeps is None else substeps):
        before = now
        if known_false(before.running.any()):
            break
        # The traffic's clock continues in ended rows: stopped at a moment of decision it would make
        # these rows' drivers decide in all remaining steps, in vain.
        vehicles = TensorDict._new_unsafe(before.vehicles.as_dict(), batch_size=size)
        fields = {keys.VEHICLES: vehicles, keys.TRAFFIC: memory, **counters, keys.STEP: start.step + count}
        after = traffic(TensorDict._new_unsafe(fields, batch_size=size))
        all_running = known_false((~before.running).any())
        now = physics.advance(rules, before, Vehicles.of(after.get(keys.MOVED)), all_running)
        if can_read:
            memory = after.get(keys.TRAFFIC)
            ended.keep(before.running & ~now.running, memory)
        else:
            memory = where(before.running, after.get(keys.TRAFFIC), memory)
        if recorder is not None:
            recorder(now.vehicles, before.running)
    return now, ended.restore(memory)


def readable(flag: Tensor) -> bool:
    """Whether Python may read ``flag``: cheap on a CPU, where it may save work; a GPU would stall."""
    return flag.device.type == "cpu"


def known_false(flag: Tensor) -> bool:
    """Whether ``flag`` can be read and is false."""
    return readable(flag) and not bool(flag)
