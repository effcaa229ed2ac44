"""First scenes of Table II in which some of the others are lorries."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ganlane.keys import EGO_INDEX
from ganlane.parameters.driving import IdmParameters
from ganlane.sim.random import Purpose, uniform
from ganlane.sim.road import Road
from ganlane.sim.scenes import RandomScenes
from ganlane.sim.vehicles import Vehicles

#: Columns of :attr:`ganlane.sim.random.Purpose.FOREIGN_DRIVER` that this module draws from.
_IS_LORRY, _DESIRED = 0, 1


@dataclass(frozen=True)
class LorryScenes:
    """:class:`ganlane.sim.scenes.RandomScenes` with lorries among the others, at the same net gaps.

    A lorry takes more of its lane, so whoever drives ahead of it there starts so much further ahead: nobody has to
    brake harder than in the scene of cars.

    Attributes:
        cars: the scenes to start from.
        share: of the others, 0 to 1; each is a lorry or not by itself.
        length_m: of a lorry; its width is that of a car.
        desired_speed_mps: (low, high) of a lorry's desired speed; 80 to 90 km/h.
    """

    cars: RandomScenes
    share: float = 0.15
    length_m: float = 12.0
    desired_speed_mps: tuple[float, float] = (22.0, 25.0)

    @property
    def vehicles(self) -> int:
        """M, the ego included."""
        return self.cars.vehicles

    @property
    def longest_m(self) -> float:
        """Length of the longest vehicle that there may be, m."""
        return max(self.cars.longest_m, self.length_m) if self.share > 0 else self.cars.longest_m

    def check(self, road: Road, idm: IdmParameters) -> None:
        """As :meth:`RandomScenes.check`."""
        self.cars.check(road, idm)

    def __call__(self, key: Tensor, dtype: torch.dtype) -> Vehicles:
        """Vehicles [N, M] at the start of the episodes with ``key`` [N]; the ego at index 0 and x = 0."""
        scene = self.cars(key, dtype)
        u = uniform(key, 0, self.vehicles, [Purpose.FOREIGN_DRIVER + _IS_LORRY, Purpose.FOREIGN_DRIVER + _DESIRED])
        is_lorry = (u[..., 0] < self.share) & (torch.arange(self.vehicles, device=key.device) != EGO_INDEX)
        length = torch.where(is_lorry, max(self.length_m, self.cars.parameters.length_m), scene.length)
        low, high = self.desired_speed_mps
        desired = torch.where(is_lorry, (low + u[..., 1] * (high - low)).to(dtype), scene.desired_speed)
        x = scene.x + _room_taken(scene, length - scene.length)
        return scene.with_(x=x - x[:, EGO_INDEX, None], length=length, desired_speed=desired)


def _room_taken(scene: Vehicles, extra: Tensor) -> Tensor:
    """How far forward each centre moves, m, [N, M], where bodies are longer by ``extra`` and net gaps stay."""
    same = scene.target_lane[:, :, None] == scene.target_lane[:, None, :]
    behind = scene.x[:, None, :] < scene.x[:, :, None]
    return (extra[:, None, :] * (same & behind)).sum(-1) + 0.5 * extra
