"""An encoder to which the order of the vehicles is nothing: the same layers for each, then the largest answer.

The list of vehicles, nearest first, changes its order whenever two of them swap ranks, and a network of plain layers
has to learn every order. The paper's reference [6] (Hoel et al. 2018) does the same with convolutions over the list
and a maximum over the vehicles.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import torch
from torch import Tensor, nn

from ganlane.agents.linear import linear
from ganlane.errors import UserError
from ganlane.parameters.agent import ENCODERS

#: What stands before the noisy layers: nothing, or :class:`VehicleEncoder`.
#: Table III: numbers of the ego at the front, numbers per vehicle, and those of the ego's lane change at the end.
OWN: Final = 3
PER_VEHICLE: Final = 3
PROGRESS: Final = 2


class VehicleEncoder(nn.Module):
    """Observations [*, D] in Table III's layout to [*, :attr:`outputs`]: the ego's own numbers and a summary.

    Every vehicle's three numbers go, beside the ego's own, through ``layers`` layers of ``width`` with ReLU, the same
    for all; the summary is the maximum over the vehicles. A vehicle that is not there takes part as Table III shows
    it, far ahead in the own lane. A single layer is monotone in each number: none of its units answers most to the
    own lane, which lies between the other two.

    Args:
        observation_size: D = 3 + 3 (M - 1), or 2 more with the ego's own lane change at the end.
        width: of the shared layers and of the summary.
        layers: how many.

    Raises:
        UserError: D is no such number.
    """

    def __init__(self, observation_size: int, width: int = 64, layers: int = 2) -> None:
        super().__init__()
        self.end = observation_size - trailing(observation_size)
        own = OWN + observation_size - self.end
        self.outputs = own + width
        widths = (PER_VEHICLE + own, *[width] * layers)
        self.layers = nn.ModuleList(nn.Linear(*pair) for pair in pairwise(widths))

    def forward(self, observation: Tensor) -> Tensor:
        """The ego's own numbers, then the summary of the others."""
        rows = observation.reshape(-1, observation.shape[-1])
        own = torch.cat((rows[:, :OWN], rows[:, self.end :]), dim=1)
        vehicles = rows[:, OWN : self.end].unflatten(1, (-1, PER_VEHICLE))
        count = vehicles.shape[1]
        hidden = torch.cat((vehicles, own[:, None].expand(-1, count, -1)), dim=-1).flatten(0, 1)
        for layer in self.layers:
            assert isinstance(layer, nn.Linear)
            hidden = linear(hidden, layer.weight, layer.bias, relu=True)
        summary = hidden.unflatten(0, (len(rows), count)).amax(1)
        return torch.cat((own, summary), dim=1).reshape(*observation.shape[:-1], self.outputs)


def trailing(observation_size: int) -> int:
    """Numbers after the list of vehicles: 2 of the ego's own lane change, or none."""
    rest = (observation_size - OWN) % PER_VEHICLE
    if rest not in (0, PROGRESS) or observation_size - rest < OWN + PER_VEHICLE:
        raise UserError(
            f"agent.encoder=shared: observations of {observation_size} numbers are not laid out as in Table III "
            "(3, then 3 per vehicle, then none or 2); use observation=table3_progress, or agent.encoder=none."
        )
    return rest


def make_encoder(name: str, observation_size: int, width: int, layers: int) -> VehicleEncoder | None:
    """The encoder that ``name`` means; None for ``none``.

    Raises:
        UserError: an unknown name, or an observation that the encoder cannot read.
    """
    if name not in ENCODERS:
        raise UserError(f"agent.encoder={name}: no such encoder; choose one of {', '.join(ENCODERS)}.")
    return VehicleEncoder(observation_size, width, layers) if name == "shared" else None
