"""Drivers of the ego that need no learning: random, random but legal, keeping its lane, MOBIL."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ganlane import keys
from ganlane.keys import EGO_INDEX, LEFT, RIGHT
from ganlane.parameters.driving import IdmParameters, MobilParameters
from ganlane.sim.dynamics import ego_scene
from ganlane.sim.idm import TABLE_V
from ganlane.sim.mobil import TABLE_IV, mobil_wishes
from ganlane.sim.random import Purpose, Stream, episode_key, uniform
from ganlane.sim.state import Road, Vehicles, road_in
from ganlane.traffic.idm_mobil import MOBIL_PERIOD_STEPS
from ganlane.transforms.mask import on_road_actions


class Driver(TensorDictModuleBase):
    """A rule-based policy: reads the raw state, writes ``action`` [N] int64 through :meth:`act`.

    Set ``rows_must_stay = True`` in one that remembers something per row in the module itself: an evaluation then
    never moves a running episode to another row, or into a smaller batch.
    """

    in_keys = [keys.VEHICLES, keys.EGO, keys.SEED, keys.EPISODE, keys.STEP]  # noqa: RUF012
    out_keys = [keys.ACTION]  # noqa: RUF012
    rows_must_stay = False

    def __init__(self, road: Road, stream: int = Stream.TRAIN) -> None:
        super().__init__()
        self.road, self.stream = road, int(stream)

    def act(self, vehicles: Vehicles, tensordict: TensorDictBase) -> Tensor:
        """The action of every row."""
        raise NotImplementedError

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``."""
        return tensordict.set(keys.ACTION, self.act(Vehicles.of(tensordict.get(keys.VEHICLES)), tensordict))


def legal_actions(tensordict: TensorDictBase, road: Road) -> Tensor:
    """Which of the three actions stay on the road, bool [N, 3]: keeping the lane always does."""
    target = tensordict.get(keys.VEHICLES).get("target_lane")[:, EGO_INDEX]
    lanes = road.lanes[:, 0] if isinstance(road.lanes, Tensor) else road.lanes
    return on_road_actions(target, lanes)


class RandomDriver(Driver):
    """Any of the three actions with equal probability; it soon drives off the road."""

    def _uniform(self, tensordict: TensorDictBase) -> Tensor:
        key = episode_key(self.stream, tensordict.get(keys.SEED), tensordict.get(keys.EPISODE))
        return uniform(key, tensordict.get(keys.STEP), 1, [Purpose.RANDOM_ACTION])[:, 0, 0]

    def act(self, vehicles: Vehicles, tensordict: TensorDictBase) -> Tensor:
        """Floor of three times a uniform number."""
        return (self._uniform(tensordict) * 3).long()


class RandomLegalDriver(RandomDriver):
    """As :class:`RandomDriver`, among the actions that stay on the road."""

    def act(self, vehicles: Vehicles, tensordict: TensorDictBase) -> Tensor:
        """The r-th legal action, r uniform."""
        legal = legal_actions(tensordict, road_in(tensordict, self.road))
        wanted = (self._uniform(tensordict) * legal.sum(1)).long()
        rank = legal.cumsum(1) - 1
        return (legal & (rank == wanted[:, None])).long().argmax(1)


class KeepLaneDriver(Driver):
    """Never changes lanes."""

    def act(self, vehicles: Vehicles, tensordict: TensorDictBase) -> Tensor:
        """Always 0."""
        return torch.zeros_like(vehicles.target_lane[:, EGO_INDEX])


class MobilDriver(Driver):
    """The ego driven by MOBIL; with ``politeness_rear=politeness_side=0`` an egoistic one."""

    def __init__(
        self, road: Road, stream: int = Stream.TRAIN, idm: IdmParameters = TABLE_V, mobil: MobilParameters = TABLE_IV
    ) -> None:
        super().__init__(road, stream)
        self.idm, self.mobil = idm, mobil

    def act(self, vehicles: Vehicles, tensordict: TensorDictBase) -> Tensor:
        """MOBIL's wish as an action, in the decisions in which a second of simulated time is full."""
        road = road_in(tensordict, self.road)
        wish = mobil_wishes(ego_scene(vehicles, road), road, self.idm, self.mobil)[:, 0]
        step, decisions = tensordict.get(keys.STEP), tensordict.get(keys.EGO).get("decisions")
        # All decisions take the same number of steps, so the last one was at step - step / decisions.
        last = step - step // decisions.clamp_min(1)
        due = (decisions == 0) | (step // MOBIL_PERIOD_STEPS != last // MOBIL_PERIOD_STEPS)
        wish = torch.where(due, wish, 0)
        return torch.where(wish > 0, LEFT, torch.where(wish < 0, RIGHT, keys.KEEP))


def egoistic_mobil(
    road: Road, stream: int = Stream.TRAIN, idm: IdmParameters = TABLE_V, mobil: MobilParameters = TABLE_IV
) -> MobilDriver:
    """MOBIL with politeness 0."""
    return MobilDriver(road, stream, idm, replace(mobil, politeness_rear=0.0, politeness_side=0.0))


#: Name to a constructor from (road, stream).
DRIVERS: dict[str, Callable[[Road, int], Driver]] = {
    "random": RandomDriver,
    "random_legal": RandomLegalDriver,
    "keep_lane": KeepLaneDriver,
    "mobil": MobilDriver,
    "mobil_egoistic": egoistic_mobil,
}
