"""Episodes in which the others do not see the ego, as in replayed recordings."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.errors import UserError
from ganlane.keys import EGO_INDEX
from ganlane.sim.random import Purpose, absorb, uniform
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import TrafficModule, memory_of


class BlindTraffic(TrafficModule):
    """Any traffic model, blind to the ego in a share of the episodes.

    In these the model is handed a state in which the ego is not valid: nobody brakes for it, makes room or waits for
    it. The environment sees it as ever: it hits others, is hit, and observes. Whether an episode is blind follows
    from (stream, seed, episode) alone. Memory: the model's as ``model``, and ``unseen`` [N, M] bool, true for the ego
    of a blind episode.

    Args:
        model: the traffic.
        blind_share: of the episodes, 0 to 1.

    Raises:
        UserError: the share is out of range, or the model plays recordings.
    """

    def __init__(self, model: TrafficModule, blind_share: float) -> None:
        if not 0.0 <= blind_share <= 1.0:
            raise UserError(f"traffic.blind_share={blind_share:g}: expected a number from 0 to 1; give such a share.")
        if model.own_roads:
            raise UserError(
                f"traffic.blind_share={blind_share:g} with replayed traffic: recorded vehicles see no ego anyway; "
                "leave it out."
            )
        super().__init__(model.road, model.stream)
        self.model, self.blind_share = model, blind_share
        self.visibility, self.rows_must_stay = model.visibility, model.rows_must_stay

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``moved`` and ``traffic``, as the model does that sees the ego in some episodes only."""
        memory, vehicles = memory_of(tensordict), tensordict.get(keys.VEHICLES)
        seen = tensordict.copy()
        valid = vehicles.get("valid") & ~memory.get("unseen")
        seen.set(keys.VEHICLES, vehicles.copy().set("valid", valid))
        seen.set(keys.TRAFFIC, memory.get("model", TensorDict({}, batch_size=tensordict.batch_size)))
        self.model(seen)
        kept = {"model": memory_of(seen), "unseen": memory.get("unseen")}
        tensordict.set(keys.MOVED, seen.get(keys.MOVED))
        tensordict.set(keys.TRAFFIC, TensorDict._new_unsafe(kept, batch_size=tensordict.batch_size))
        return tensordict

    def unseen(self, vehicles: Vehicles, key: Tensor) -> Tensor:
        """Whom the others do not see: the egos of blind episodes, bool [N, M]; ``key`` as for fresh memory."""
        blind = uniform(key, -1, 1, [Purpose.BLIND_EPISODE], torch.float64)[..., 0] < self.blind_share
        return blind & (torch.arange(vehicles.x.shape[1], device=key.device) == EGO_INDEX)

    def enter(self, vehicles: Vehicles, key: Tensor, episode: Tensor) -> tuple[Vehicles, TensorDictBase]:
        """As the model; and which episodes are blind."""
        vehicles, memory = self.model.enter(vehicles, key, episode)
        named = {"model": memory, "unseen": self.unseen(vehicles, absorb(key, 0))}
        return vehicles, TensorDict._new_unsafe(named, batch_size=torch.Size([vehicles.x.shape[0]]))

    def init_memory(self, vehicles: Vehicles, who: Tensor, key: Tensor) -> TensorDict:
        """As the model's; and which episodes are blind."""
        named = {"model": self.model.init_memory(vehicles, who, key), "unseen": self.unseen(vehicles, key)}
        return TensorDict(named, batch_size=[vehicles.x.shape[0]])

    def memory_spec(self, n: int, m: int, dtype: torch.dtype = torch.float32) -> dict[str, Any]:
        """The model's spec, and who is not seen."""
        return {"model": self.model.memory_spec(n, m, dtype), "unseen": ((n, m), torch.bool)}

    def compile_graphs(self) -> None:
        """Compile the model."""
        self.model.compile_graphs()
