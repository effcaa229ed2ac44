"""Sensor errors as a TorchRL transform: what the ego perceives of the others is noisy, has gaps and comes late.

The transform writes ``perceived`` next to ``vehicles``; observation and mask use ``perceived`` where it is present.
Physics, reward, events and the rule-based drivers read the true ``vehicles``. Measurements that are not yet delivered
travel in the TensorDict as ``sensors``, so a state can be saved, branched and resumed.

=================================  ===============  ================================================
``perceived.x, y, speed, valid``   [N, M]           the scene as it was measured ``delay_s`` ago
``sensors.x, y, speed, valid``     [N, K, M]        the last K measurements, oldest first (with a delay
                                                    of K decisions)
=================================  ===============  ================================================

Column 0 is the ego where it was when it measured, without error: what it perceives is relative to that.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from ganlane import keys
from ganlane.errors import UserError
from ganlane.parameters.observation import SensorParameters
from ganlane.sim.random import Purpose, Stream, episode_key, normal, uniform
from ganlane.sim.state import Vehicles

PERCEIVED: Final = "perceived"
SENSORS: Final = "sensors"
NOISES: Final = [Purpose.SENSED_POSITION, Purpose.SENSED_LATERAL, Purpose.SENSED_SPEED]


class Measurement(NamedTuple):
    """A scene as measured by the ego's sensors, fields [N, M] or [N, K, M], the ego first; m, m/s."""

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
    """A measurement of ``vehicles`` [N, M], without the delay.

    Args:
        vehicles: the true state.
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


def perceived(state: TensorDictBase, vehicles: Vehicles) -> Vehicles:
    """``vehicles`` as the ego perceives them in ``state``; unchanged without a :class:`SensorTransform`."""
    seen = state.get(PERCEIVED, None)
    return vehicles if seen is None else vehicles.with_(**Measurement.of(seen)._asdict())


class PerceptionTransform(Transform):
    """Base of the transforms that read what the ego perceives: subclasses implement :meth:`write`."""

    def write(self, state: TensorDictBase, vehicles: Vehicles, seen: Vehicles) -> TensorDictBase:
        """Write the out keys into ``state``; ``vehicles`` are true, ``seen`` as the ego perceives them."""
        raise NotImplementedError

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the out keys into any TensorDict that holds the raw state."""
        vehicles = Vehicles.of(tensordict.get(keys.VEHICLES))
        return self.write(tensordict, vehicles, perceived(tensordict, vehicles))

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self.forward(tensordict_reset)


class SensorTransform(Transform):
    """Write ``perceived``, and with a delay ``sensors``; belongs before the :class:`ObservationTransform`.

    The errors follow from (stream, seed, episode, vehicle, physics step, purpose), so an episode is the same in any
    batch and when it is replayed. The ego measures once per decision, at its end; until the first measurement of an
    episode is old enough, that one is delivered.

    Args:
        parameters: sizes of the errors; None: none.
        stream: the environment's.
        decision_period_s: the environment's.

    Raises:
        UserError: the delay is not a multiple of the decision period; in a step, if the state comes from an
            environment without this delay.
    """

    def __init__(
        self,
        parameters: SensorParameters | None = None,
        stream: int = Stream.TRAIN,
        decision_period_s: float = 1.0,
    ) -> None:
        in_keys = [keys.VEHICLES, keys.SEED, keys.EPISODE, keys.STEP]
        super().__init__(in_keys=in_keys, out_keys=[PERCEIVED])
        self.parameters = parameters or SensorParameters()
        self.stream = int(stream)
        self.delay = self.parameters.delay_decisions(decision_period_s)

    def measured(self, state: TensorDictBase) -> Measurement:
        """The measurement of the true state in ``state``, fields [N, M]."""
        key = episode_key(self.stream, state.get(keys.SEED), state.get(keys.EPISODE))
        return measure(Vehicles.of(state.get(keys.VEHICLES)), key, state.get(keys.STEP), self.parameters)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        new = self.measured(next_tensordict)
        if self.delay == 0:
            return next_tensordict.set(PERCEIVED, new.as_tensordict())
        held = tensordict.get(SENSORS, None)
        if held is None or held.get("x").shape[1] != self.delay:
            raise UserError(
                f"the state holds no {self.delay} measurements under {SENSORS!r}: it comes from an environment with "
                "other sensors; start from a reset of this one."
            )
        kept = Measurement.of(held)
        moved = (torch.cat((old[:, 1:], fresh[:, None]), dim=1) for old, fresh in zip(kept, new))
        next_tensordict.set(SENSORS, Measurement(*moved).as_tensordict())
        oldest = Measurement(*(old[:, 0].clone() for old in kept))
        return next_tensordict.set(PERCEIVED, oldest.as_tensordict())

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        first = self.measured(tensordict_reset)
        if self.delay > 0:
            filled = (field[:, None].repeat(1, self.delay, 1) for field in first)
            tensordict_reset.set(SENSORS, Measurement(*filled).as_tensordict())
        return tensordict_reset.set(PERCEIVED, first.as_tensordict())

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write what the ego would perceive if the raw state in ``tensordict`` were an episode's first."""
        return self._reset(tensordict, tensordict)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add ``perceived``, and with a delay ``sensors``, to the spec."""
        assert isinstance(observation_spec, Composite)
        true = observation_spec[keys.VEHICLES, "x"]
        rows, count = true.shape
        observation_spec[PERCEIVED] = _spec((rows, count), true.dtype).to(true.device)
        if self.delay > 0:
            observation_spec[SENSORS] = _spec((rows, self.delay, count), true.dtype).to(true.device)
        return observation_spec


def _spec(shape: tuple[int, ...], dtype: torch.dtype) -> Composite:
    """Spec of a :class:`Measurement` with fields of this shape."""
    floats = {name: Unbounded(shape=shape, dtype=dtype) for name in ("x", "y", "speed")}
    return Composite({**floats, "valid": Binary(shape=shape, dtype=torch.bool)}, shape=shape[:1])
