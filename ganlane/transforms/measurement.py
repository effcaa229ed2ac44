"""What the ego's sensors deliver of a scene: noise and gaps in a single measurement."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.errors import UserError
from ganlane.sim.random import Purpose, normal, uniform
from ganlane.sim.vehicles import Vehicles

NOISES: Final = [Purpose.SENSED_POSITION, Purpose.SENSED_LATERAL, Purpose.SENSED_SPEED]
#: How far a delay may be from a whole number of decisions, in decisions.
TOLERANCE: Final = 1e-6


@dataclass(frozen=True)
class SensorParameters:
    """Errors in what the ego perceives of the other vehicles; all 0: none.

    Standard deviations of independent Gaussian errors of the position along the road, across it, and of the speed
    (drawn anew for every vehicle and decision); the probability that a vehicle is not seen in a decision; the age
    of what is perceived, a whole number of decisions.
    """

    position_noise_m: float = 0.0
    lateral_noise_m: float = 0.0
    speed_noise_mps: float = 0.0
    dropout: float = 0.0
    delay_s: float = 0.0

    def delay_decisions(self, decision_period_s: float) -> int:
        """The delay in decisions.

        Raises:
            UserError: it is none, or not a whole number of them.
        """
        decisions = self.delay_s / decision_period_s
        if decisions < 0 or abs(decisions - round(decisions)) > TOLERANCE:
            raise UserError(
                f"observation.sensors.delay_s={self.delay_s:g}: expected a multiple of the decision period "
                f"(env.decision_period_s={decision_period_s:g}), since the ego measures once per decision; change "
                "one of them."
            )
        return round(decisions)


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
