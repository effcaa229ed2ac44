"""What the ego perceives of the other vehicles: with noise, gaps and a delay.

:class:`SensorTransform` writes ``perceived`` next to ``vehicles``. Observation and mask use it
where it is present; physics, reward, events and rule-based drivers read the true ``vehicles``.
Measurements not yet delivered travel in the TensorDict as ``sensors``, so a state can be saved,
branched and resumed.

===============================  =========  ======================================================
``perceived.x, y, speed, valid`` [N, M]     the scene as it was measured ``delay_s`` ago; m, m/s
``sensors.x, y, speed, valid``   [N, K, M]  the last K measurements, oldest first (with a delay of K
                                            decisions)
===============================  =========  ======================================================

Column 0 is the ego where it was when it measured, without error: what it perceives is relative to
that.
"""

from __future__ import annotations

from typing import Final

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.errors import UserError
from ganlane.settings.observation import SensorParameters
from ganlane.sim.random import Purpose, Stream, episode_key, normal, uniform
from ganlane.sim.state import Vehicles
from ganlane.transforms.base import StateTransform

PERCEIVED: Final = "perceived"
SENSORS: Final = "sensors"
#: Purposes of the errors of x, y and speed.
_SENSED: list[int] = [Purpose.SENSED_POSITION, Purpose.SENSED_LATERAL, Purpose.SENSED_SPEED]


def measure(
    vehicles: Vehicles, key: Tensor, step: Tensor, parameters: SensorParameters
) -> TensorDictBase:
    """``x, y, speed, valid`` [N, M] as measured at the physics steps ``step`` [N]; no delay.

    Args:
        vehicles: the true ones, [N, M].
        key: of the episodes, [N] int64 (:func:`ganlane.sim.random.episode_key`).
        step: physics steps since their start, [N] int64.
        parameters: sizes of the errors.
    """
    values = {
        "x": vehicles.x,
        "y": vehicles.y,
        "speed": vehicles.speed,
    }
    valid = vehicles.valid
    count = valid.shape[1]
    dtype = vehicles.x.dtype

    # Column 0 stays exact: the ego knows itself.
    other = torch.arange(count, device=valid.device) != keys.EGO_INDEX

    # Standard deviations of x, y (m) and speed (m/s).
    scales = (
        parameters.position_noise_m,
        parameters.lateral_noise_m,
        parameters.speed_noise_mps,
    )
    if any(scales):
        noise = normal(key, step, count, _SENSED, dtype).unbind(-1)
        for (name, value), scale, error in zip(values.items(), scales, noise):
            noisy = value + scale * error
            values[name] = torch.where(other, noisy, value)

    # A vehicle that drops out is as one that is not there.
    if parameters.dropout > 0:
        drawn = uniform(key, step, count, [Purpose.SENSED_DROPOUT], dtype)[..., 0]
        drops_out = (drawn < parameters.dropout) & other
        valid = valid & ~drops_out

    values["valid"] = valid
    return TensorDict._new_unsafe(values, batch_size=valid.shape[:1], device=valid.device)


class PerceptionTransform(StateTransform):
    """Base of the transforms of what the ego perceives; subclasses implement :meth:`write`."""

    def write(self, state: TensorDictBase, vehicles: Vehicles, seen: Vehicles) -> TensorDictBase:
        """Write the out keys into ``state``.

        ``vehicles`` are true, ``seen`` as the ego perceives them.
        """
        raise NotImplementedError

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the out keys into any TensorDict that holds the raw state."""
        vehicles = Vehicles.of(tensordict.get(keys.VEHICLES))
        seen = vehicles
        # Without sensors the ego sees what there is.
        perceived = tensordict.get(PERCEIVED, None)
        if perceived is not None:
            seen = vehicles.with_(**dict(perceived.items()))
        return self.write(tensordict, vehicles, seen)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self.forward(tensordict_reset)


class SensorTransform(StateTransform):
    """Write ``perceived``, and with a delay ``sensors``; belongs before the observation.

    The errors follow from (stream, seed, episode, vehicle, physics step, purpose), so an episode is
    the same in any batch and when it is replayed. The ego measures once per decision, at its end;
    until the first measurement of an episode is old enough, that one is delivered.

    Args:
        parameters: sizes of the errors; None: none.
        stream, decision_period_s: the environment's.

    Raises:
        UserError: the delay is not a multiple of the decision period; in a step, if the state comes
            from an environment without this delay.
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

    def _measured(self, state: TensorDictBase) -> TensorDictBase:
        """The measurement of the true state in ``state``."""
        vehicles = Vehicles.of(state.get(keys.VEHICLES))
        # The traffic's key: purposes of their own keep the numbers apart.
        key = episode_key(self.stream, state.get(keys.SEED), state.get(keys.EPISODE))
        return measure(vehicles, key, state.get(keys.STEP), self.parameters)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        # One measurement in per decision, one out: the queue keeps its length.
        newest = self._measured(next_tensordict)
        if self.delay == 0:
            return next_tensordict.set(PERCEIVED, newest)

        waiting = tensordict.get(SENSORS, None)
        if waiting is None or waiting.get("x").shape[1] != self.delay:
            raise UserError(
                f"the state holds no {self.delay} measurements under {SENSORS!r}: it comes from an "
                "environment with other sensors; start from a reset of this one."
            )

        # The oldest measurement is delivered ...
        oldest = waiting.apply(lambda queue: queue[:, 0].clone())
        next_tensordict.set(PERCEIVED, oldest)

        # ... and the newest joins the end of the queue, in every field [N, K, M].
        queues = waiting.apply(
            lambda queue, new: torch.cat((queue[:, 1:], new[:, None]), dim=1),
            newest,
        )
        return next_tensordict.set(SENSORS, queues)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        first = self._measured(tensordict_reset)
        if self.delay > 0:
            # Until a measurement is old enough, the first one is delivered.
            queues = first.apply(lambda new: new[:, None].repeat(1, self.delay, 1))
            tensordict_reset.set(SENSORS, queues)
        return tensordict_reset.set(PERCEIVED, first)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write what the ego would perceive if the raw state were an episode's first."""
        return self._reset(tensordict, tensordict)
