"""Traffic models in a chain: a base model, then overlays and guards that rewrite what it moved."""

from __future__ import annotations

from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from ganlane import keys
from ganlane.errors import UserError
from ganlane.runtime import compiled
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import TrafficModule, memory_of


class Overlay(TrafficModule):
    """A traffic module that does not move vehicles itself but rewrites ``moved``.

    Subclasses implement :meth:`rewrite` in place of :meth:`TrafficModule.move`.
    """

    def rewrite(
        self, vehicles: Vehicles, moved: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor
    ) -> tuple[Vehicles, dict[str, Tensor]]:
        """The new ``moved``, and the memory to keep; arguments as in :meth:`TrafficModule.move`."""
        raise NotImplementedError

    def _call(
        self, tensordict: TensorDictBase, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor
    ) -> tuple[Vehicles, dict[str, Tensor]]:
        moved = Vehicles.of(tensordict.get(keys.MOVED))
        return self.rewrite(vehicles, moved, memory, key, tensordict.get(keys.STEP))

    def compile_graphs(self) -> None:
        """Compile :meth:`rewrite`."""
        self.rewrite = compiled(self.rewrite)  # type: ignore[method-assign]


class TrafficSequential(TrafficModule):
    """A base model followed by overlays, each with a memory of its own under its name.

    Args:
        parts: name to module, the base model first. Road, stream and visibility are the first one's.

    Raises:
        UserError: the base model plays recordings.
    """

    def __init__(self, parts: dict[str, TrafficModule]) -> None:
        base = next(iter(parts.values()))
        if base.own_roads:
            raise UserError("overlays behind replayed traffic: they go where they went; lay faults over a model.")
        super().__init__(base.road, base.stream)
        self.parts = nn.ModuleDict(parts)
        self.visibility = base.visibility
        self.rows_must_stay = any(part.rows_must_stay for part in parts.values())

    def named_parts(self) -> list[tuple[str, TrafficModule]]:
        """Names and parts, in order."""
        return [(name, cast(TrafficModule, part)) for name, part in self.parts.items()]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Run the parts in order."""
        memories, nothing = memory_of(tensordict), TensorDict({}, batch_size=tensordict.batch_size)
        kept = {}
        for name, part in self.named_parts():
            tensordict.set(keys.TRAFFIC, memories.get(name, nothing))
            part(tensordict)
            kept[name] = tensordict.get(keys.TRAFFIC)
        tensordict.set(keys.TRAFFIC, TensorDict._new_unsafe(kept, batch_size=tensordict.batch_size))
        return tensordict

    def compile_graphs(self) -> None:
        """Compile every part."""
        for _, part in self.named_parts():
            part.compile_graphs()

    def init_memory(self, vehicles: Vehicles, who: Tensor, key: Tensor) -> TensorDict:
        """The parts' memories, by name."""
        memories = {name: part.init_memory(vehicles, who, key) for name, part in self.named_parts()}
        return TensorDict(memories, batch_size=[vehicles.x.shape[0]])

    def enter(self, vehicles: Vehicles, key: Tensor, episode: Tensor) -> tuple[Vehicles, TensorDictBase]:
        """The vehicles as the parts have them, one after the other, and the parts' memories by name."""
        memories = {}
        for name, part in self.named_parts():
            vehicles, memories[name] = part.enter(vehicles, key, episode)
        return vehicles, TensorDict(memories, batch_size=[vehicles.x.shape[0]])

    def memory_spec(self, n: int, m: int, dtype: torch.dtype = torch.float32) -> dict[str, Any]:
        """The parts' specs, by name."""
        return {name: part.memory_spec(n, m, dtype) for name, part in self.named_parts()}
