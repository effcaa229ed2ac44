"""Sensor errors as a TorchRL transform: what the ego perceives of the others is noisy, has gaps and comes late.

:mod:`~ganlane.transforms.measurement` says what a single measurement delivers, this module when the ego has it.
The transform writes ``perceived`` beside ``vehicles``; the observation is made of ``perceived`` where there is one.
Physics, reward, events and the rule-based drivers go on reading the true ``vehicles``. What is still to be delivered
travels in the TensorDict as ``sensors``, so a state can be saved, branched and resumed.

=================================  ===============  ================================================
``perceived.x, y, speed, valid``   [N, M]           the scene as it was measured ``delay_s`` ago
``sensors.x, y, speed, valid``     [N, K, M]        the last K measurements, oldest first (with a delay
                                                    of K decisions)
=================================  ===============  ================================================

Column 0 is the ego where it was when it measured, without error: what it perceives is relative to that.
"""

from __future__ import annotations

from typing import Final

import torch
from tensordict import TensorDictBase
from torchrl.data import Binary, Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from ganlane import keys
from ganlane.errors import UserError
from ganlane.sim.random import Stream, episode_key
from ganlane.sim.vehicles import Vehicles
from ganlane.transforms.measurement import Measurement, SensorParameters, measure

PERCEIVED: Final = "perceived"
SENSORS: Final = "sensors"


class SensorTransform(Transform):
    """Write ``perceived``, and with a delay ``sensors``; stands before the :class:`ObservationTransform`.

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
        kept = self._kept(tensordict)
        moved = (torch.cat((old[:, 1:], fresh[:, None]), dim=1) for old, fresh in zip(kept, new))
        next_tensordict.set(SENSORS, Measurement(*moved).as_tensordict())
        oldest = Measurement(*(old[:, 0].clone() for old in kept))
        return next_tensordict.set(PERCEIVED, oldest.as_tensordict())

    def _kept(self, state: TensorDictBase) -> Measurement:
        """The measurements that ``state`` carries, fields [N, K, M]."""
        kept = state.get(SENSORS, None)
        if kept is None or kept.get("x").shape[1] != self.delay:
            raise UserError(
                f"the state holds no {self.delay} measurements under {SENSORS!r}: it comes from an environment with "
                "other sensors; start from a reset of this one."
            )
        return Measurement.of(kept)

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


def perceived(state: TensorDictBase, vehicles: Vehicles) -> Vehicles:
    """``vehicles`` as the ego perceives them in ``state``: as they are, if no sensors stand between."""
    seen = state.get(PERCEIVED, None)
    return vehicles if seen is None else vehicles.with_(**Measurement.of(seen)._asdict())
