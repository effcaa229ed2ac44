"""What all traffic that a generator drives shares: a history and a latent vector per driver.

A vehicle that enters, at the start of an episode or when it is put back in front, has always driven straight
along its lane at its present speed: that is how its history is filled. Its latent vector is drawn at the same
time and then wanders, with a memory of its own for every vehicle. The ego is a neighbour like any other.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.errors import UserError
from ganlane.generator.closed_loop import History, start, wander
from ganlane.generator.networks import Generator
from ganlane.keys import PHYSICS_STEP_S
from ganlane.parameters.driving import Visibility
from ganlane.sim.random import Purpose, Stream, normal
from ganlane.sim.road import Road
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import MemoryFields, TrafficModule

#: Latent dimensions that have a purpose of their own in :class:`ganlane.sim.random.Purpose`.
_MOST_NOISE = int(Purpose.RECYCLE) - int(Purpose.NOISE)


class GeneratedTraffic(TrafficModule):
    """What both presets share: the history and the latent vectors.

    Memory: ``motion_0``, ``motion_1`` and so on, [N, M, 4H] each (input projections of the last observed - 1 motions,
    oldest first), ``displacement`` [N, M, 2] (the newest of them, m), ``noise`` [N, M, Z].

    Args:
        generator: the fitted network (:func:`ganlane.generator.load_generator`).
        road, stream: as for every traffic module.
        noise_period_s: time in which a driver's latent vector is forgotten; 0 draws it anew at every step.
        noise_scale: 1 samples as fitted, 0 drives everybody by the mean prediction (z = 0).

    Raises:
        UserError: the generator is one of the other preset, or its latent vector is too long.
    """

    visibility = Visibility.BODY
    extra_inputs = 0

    def __init__(
        self,
        generator: Generator,
        road: Road | None = None,
        stream: int = Stream.TRAIN,
        noise_period_s: float = 5.0,
        noise_scale: float = 1.0,
    ) -> None:
        super().__init__(road, stream)
        sizes = generator.sizes
        if sizes.extra_inputs != self.extra_inputs or sizes.noise > _MOST_NOISE:
            raise UserError(
                f"generator with {sizes.extra_inputs} further inputs and {sizes.noise} latent numbers: expected "
                f"{self.extra_inputs} and at most {_MOST_NOISE}; give the weights of this traffic's own preset."
            )
        self.generator = generator
        self.noise_period_s, self.noise_scale = noise_period_s, noise_scale
        self.motions = [f"motion_{index}" for index in range(sizes.observed - 1)]
        self.purposes = [Purpose.NOISE + index for index in range(sizes.noise)]

    @property
    def memory_fields(self) -> MemoryFields:  # type: ignore[override]
        """Trailing shapes of the memory."""
        sizes = self.generator.sizes
        motions: MemoryFields = {name: ((4 * sizes.hidden,), None) for name in self.motions}
        return {**motions, "displacement": ((2,), None), "noise": ((sizes.noise,), None)}

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> dict[str, Tensor]:
        """Straight driving at the present speed, and latent vectors of this episode."""
        along = vehicles.speed * PHYSICS_STEP_S
        history = start(self.generator, torch.stack([along, torch.zeros_like(along)], dim=-1))
        noise = normal(key, -1, vehicles.x.shape[1], self.purposes, vehicles.x.dtype)
        return {**self.kept(history), "noise": noise}

    def history(self, memory: dict[str, Tensor]) -> History:
        """The past of all drivers."""
        return History(tuple(memory[name] for name in self.motions), memory["displacement"])

    def kept(self, history: History) -> dict[str, Tensor]:
        """The past as it stands in the memory; its motions are moved on by name, not copied."""
        return {**dict(zip(self.motions, history.motions)), "displacement": history.displacement}

    def next_noise(self, memory: dict[str, Tensor], key: Tensor, step: Tensor) -> Tensor:
        """The latent vectors [N, M, Z] for this step."""
        noise = memory["noise"]
        fresh = normal(key, step, noise.shape[1], self.purposes, noise.dtype)
        return wander(noise, fresh, self.noise_period_s)
