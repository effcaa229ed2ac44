"""A user's own traffic model and policy, as a user would write them.

Nothing of the package is touched.
"""

import torch
from tensordict.nn import TensorDictModuleBase

from ganlane.traffic import TrafficModule


class Cruise(TrafficModule):
    """Everybody drives on at a share of its speed, whatever stands in the way."""

    def __init__(self, road, stream, share: float = 1.0):
        super().__init__(road, stream)
        self.share = share

    def move(self, vehicles, memory, key, step):
        return vehicles.with_(x=vehicles.x + self.share * vehicles.speed * self.dt), memory


class Stubborn(TensorDictModuleBase):
    """Always keeps its lane."""

    in_keys = ("episode",)
    out_keys = ("action",)

    def forward(self, tensordict):
        return tensordict.set("action", torch.zeros_like(tensordict["episode"]))
