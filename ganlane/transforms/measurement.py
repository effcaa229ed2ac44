"""What the ego's sensors deliver of a scene: noise and gaps in a single measurement."""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.parameters.observation import SensorParameters
from ganlane.sim.random import Purpose, normal, uniform
from ganlane.sim.vehicles import Vehicles

NOISES: Final = [Purpose.SENSED_POSITION, Purpose.SENSED_LATERAL, Purpose.SENSED_SPEED]


class Measurement(NamedTuple):
    """A scene as the ego's sensors have it, fields [N, M] (or [N, K, M] for K of them), the ego first; m, m/s."""

    x: Tensor
    y: Tensor
    speed: Tensor
    valid: Tensor

    @classmethod
    def of(cls, mapping: TensorDictBase) -> Measurement:
        """From a TensorDict that holds the fields."""
        return cls(*(mapping.get(name) for name in cls._fields))

    def as_tensordict(self) -> TensorDictBase:
        """The fields by name, batch [N]."""
        return TensorDict._new_unsafe(self._asdict(), batch_size=self.x.shape[:1], device=self.x.device)


def measure(vehicles: Vehicles, key: Tensor, step: Tensor, parameters: SensorParameters) -> Measurement:
    """What the sensors deliver of ``vehicles`` [N, M], but for the delay.

    Args:
        vehicles: the true state, which stays as it is.
        key: of the episodes, [N] (:func:`ganlane.sim.random.episode_key`).
        step: physics step of the measurement, [N].
        parameters: sizes of the errors.
    """
    x, y, speed, valid = vehicles.x, vehicles.y, vehicles.speed, vehicles.valid
    scales = (parameters.position_noise_m, parameters.lateral_noise_m, parameters.speed_noise_mps)
    count = x.shape[1]
    other = torch.arange(count, device=x.device) != keys.EGO_INDEX
    if any(scales):
        noise = normal(key, step, count, [int(purpose) for purpose in NOISES], x.dtype)
        x, y, speed = (
            torch.where(other, value + scale * noise[..., i], value)
            for i, (value, scale) in enumerate(zip((x, y, speed), scales))
        )
    if parameters.dropout > 0:
        lost = uniform(key, step, count, [int(Purpose.SENSED_DROPOUT)], x.dtype)[..., 0] < parameters.dropout
        valid = valid & ~(lost & other)
    return Measurement(x, y, speed, valid)
