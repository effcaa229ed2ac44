"""Social pooling over pairs of vehicles: masked, padded, the nearest only, the first layer split in two.

The original (Gupta et al. 2018) loops over scenes and runs a layer on the concatenation of relative position
and the other's state for every pair. That layer is linear and looks at differences of positions, so it is a part of
the other less a part of one's own: computed once for each vehicle, subtracted for every pair.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ganlane.generator.dense import apply

#: Relative position and relative displacement, in these units (m, m per 0.1 s), along and across the road.
_POSITION_SCALE_M = (20.0, 4.0)
_MOTION_SCALE_M = (0.4, 0.05)
#: Who is further away than this, along the road, has no influence.
RANGE_M = 100.0
_PAIR_FEATURES = 4
#: Taken from what does not count: far below everything that does.
_BEYOND = 1e9


def nearest(position: Tensor, valid: Tensor, neighbours: int) -> tuple[Tensor | None, Tensor]:
    """The ``neighbours`` nearest other vehicles of each: indices [B, G, K] and whether each is one, [B, G, K].

    ``position`` is [B, G, 2] in m, ``valid`` [B, G]. With too few vehicles to choose from there are no indices
    (None) and K is G, everybody in order. Padding, the vehicle itself and who is out of :data:`RANGE_M` are
    marked false.
    """
    count = position.shape[-2]
    offset = position[..., None, :, :] - position[..., :, None, :]
    alone = torch.eye(count, dtype=torch.bool, device=position.device)
    seen = valid[..., None, :] & ~alone & (offset[..., 0].abs() <= RANGE_M)
    if count - 1 <= neighbours:
        return None, seen
    distance = (offset * offset).sum(-1).masked_fill(~seen, torch.inf)
    index = distance.topk(neighbours, dim=-1, largest=False).indices
    return index, seen.gather(-1, index)


def gather_vehicles(values: Tensor, index: Tensor | None) -> Tensor:
    """Rows [B, G, K, F] of ``values`` [B, G, F] at ``index`` [B, G, K]; all of them, [B, 1, G, F], without one."""
    if index is None:
        return values[..., None, :, :]
    batch, count, chosen = index.shape
    flat = index.reshape(batch, count * chosen, 1).expand(-1, -1, values.shape[-1])
    return values.gather(1, flat).reshape(batch, count, chosen, values.shape[-1])


class PairPooling(nn.Module):
    """Max pooling of two layers over each vehicle's nearest neighbours; zeros where there is none.

    Args:
        hidden: width H of the vehicles' states.
        inner: width of the first layer.
        pooled: width P of the result.
        neighbours: how many of the nearest count; with 0 everybody is alone.
    """

    def __init__(self, hidden: int, inner: int, pooled: int, neighbours: int):
        super().__init__()
        self.neighbours = neighbours
        self.per_pair = nn.Linear(_PAIR_FEATURES, inner)
        self.per_vehicle = nn.Linear(hidden, inner, bias=False)
        self.second = nn.Linear(inner, pooled)

    def forward(self, hidden: Tensor, position: Tensor, displacement: Tensor, valid: Tensor) -> Tensor:
        """Pooled states [B, G, P] of states [B, G, H], positions and displacements [B, G, 2] and mask [B, G]."""
        if self.neighbours == 0:
            return hidden.new_zeros(*hidden.shape[:-1], self.second.out_features)
        index, seen = nearest(position, valid, self.neighbours)
        # Positions from the first vehicle: far down the road differences of large numbers would lose digits.
        state = _scaled(position - position[..., :1, :], displacement)
        own = nn.functional.linear(state, self.per_pair.weight)
        others = gather_vehicles(apply(self.per_vehicle, hidden) + own + self.per_pair.bias, index)
        first = (others - own[..., None, :]).relu_()
        second = apply(self.second, first).add_(~seen[..., None], alpha=-_BEYOND)
        return torch.relu(second.amax(dim=-2))


def _scaled(position: Tensor, displacement: Tensor) -> Tensor:
    scale = position.new_tensor((*_POSITION_SCALE_M, *_MOTION_SCALE_M))
    return torch.cat([position, displacement], dim=-1) / scale
