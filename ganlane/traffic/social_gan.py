"""Traffic driven by a generator: the paper's preset and the calibrated one.

A vehicle that enters has always driven straight along its lane at its present speed: so its history
is filled. Its latent vector is drawn at the same time and then wanders, one per vehicle. The ego is
a neighbour like any other.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from ganlane.errors import UserError
from ganlane.generator.closed_loop import (
    DriverMemory,
    History,
    anchored_step,
    headway_from_uniform,
    paper_step,
    start,
    wander,
)
from ganlane.generator.networks import Generator
from ganlane.keys import PHYSICS_STEP_S
from ganlane.native.drivers import GeneratedDrivers
from ganlane.settings.driving import MobilParameters, Visibility
from ganlane.settings.generator import EXTRA_INPUTS
from ganlane.sim.mobil import TABLE_IV, yielding
from ganlane.sim.random import Purpose, normal
from ganlane.sim.state import Road, Vehicles
from ganlane.traffic.base import Memory, Moved, TrafficModule, in_dtype, uniforms

#: Latent dimensions that :class:`ganlane.sim.random.Purpose` has room for.
_MOST_NOISE = int(Purpose.RECYCLE) - int(Purpose.NOISE)


class GeneratedTraffic(TrafficModule):
    """Base of both presets: history and latent vectors.

    Memory: ``motion_0``, ``motion_1`` and so on, [N, M, 4H] each (input projections of the last
    observed - 1 motions, oldest first), ``displacement`` [N, M, 2] (the newest of them, m),
    ``noise`` [N, M, Z].

    Args:
        generator: the fitted network (:func:`ganlane.generator.load_generator`).
        drivers: the same for the native kernel: their noise, anchor and headways, their stream.
        road: as for every traffic module.

    Raises:
        UserError: the generator belongs to the other preset, or its latent vector is too long.
    """

    visibility = Visibility.BODY
    #: By its guard or anchor, and where lane changes are laid over it.
    heeds_lane_ends = True
    #: Inputs besides the motion; another number means weights of the other preset.
    extra_inputs = 0

    def __init__(
        self, generator: Generator, drivers: GeneratedDrivers, road: Road | None = None
    ) -> None:
        super().__init__(road, drivers.stream)
        sizes = generator.sizes
        # Purposes of the latent vector end where those of recycling begin.
        if sizes.extra_inputs != self.extra_inputs or sizes.noise > _MOST_NOISE:
            raise UserError(
                f"generator with {sizes.extra_inputs} further inputs and {sizes.noise} latent "
                f"numbers: expected {self.extra_inputs} and at most {_MOST_NOISE}; give the "
                "weights of this traffic's own preset."
            )
        self.generator = generator
        self.drivers = drivers
        # A tensor per motion, so that a step renames them instead of moving numbers.
        self.motions = [f"motion_{index}" for index in range(sizes.observed - 1)]
        # A purpose per latent dimension keeps them independent.
        self.purposes = [Purpose.NOISE + index for index in range(sizes.noise)]

        # The same as the kernel's, in the run's float type: there the names are paths of keys, and
        # those of the overlays are among them.
        fields = {}
        for path, (_, shape) in drivers.memory().items():
            if path[1] == "generator":
                fields[path[-1]] = (shape, None)
        self.memory_fields = fields

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> Memory:
        """Straight driving at the present speed, and latent vectors of this episode."""
        # Metres per step along the lane, none across.
        along = vehicles.speed * PHYSICS_STEP_S
        displacement = torch.stack([along, torch.zeros_like(along)], dim=-1)
        network = in_dtype(self.generator, vehicles.x.dtype)
        history = start(network, displacement)

        # Step -1: before the first step of the episode.
        noise = normal(key, -1, along.shape[1], self.purposes, along.dtype)
        return {**self.remember(history), "noise": noise}

    def remember(self, history: History) -> Memory:
        """The history as memory; motions move on by name, without copies."""
        motions = dict(zip(self.motions, history.motions))
        return {**motions, "displacement": history.displacement}

    def before(self, memory: Memory, key: Tensor, step: Tensor) -> tuple[History, Tensor]:
        """The drivers' history from the memory, and the latent vectors [N, M, Z] of this step."""
        motions = tuple(memory[name] for name in self.motions)
        history = History(motions, memory["displacement"])

        # An autoregressive process: the latent vector keeps its variance and forgets slowly.
        noise = memory["noise"]
        fresh = normal(key, step, noise.shape[1], self.purposes, noise.dtype)
        return history, wander(noise, fresh, self.drivers.noise_period_s)


class SocialGanTraffic(GeneratedTraffic):
    """``traffic=gan``: the paper's preset, positions only.

    The first predicted displacement moves the vehicle.
    It knows neither lanes nor road: alone the closed loop drifts (design, section 4), so a guard
    belongs behind it. Lane changes and sudden accelerations are overlays.
    """

    @torch.no_grad()
    def move(self, vehicles: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        """Predict, and drive the first displacement."""
        network = in_dtype(self.generator, vehicles.x.dtype)
        history, noise = self.before(memory, key, step)
        # Scaled for the network alone: the memory keeps unit variance.
        latent = self.drivers.noise_scale * noise
        moved, history = paper_step(network, vehicles, history, latent)
        return moved, {**self.remember(history), "noise": noise}


class AnchoredGanTraffic(GeneratedTraffic):
    """``traffic=gan_calibrated``: the network's residual on an anchor of IDM and lane keeping.

    It follows ``vehicles.target_lane``, which an overlay sets, and ``vehicles.desired_speed``.

    Additional memory: ``residual_mean`` [N, M, 2] in m/s2 (the washout), ``headway`` [N, M] in s.

    Args:
        generator, drivers, road: as of the base.
        mobil: how drivers make room for those who have to leave a lane that ends.
    """

    extra_inputs = EXTRA_INPUTS

    def __init__(
        self,
        generator: Generator,
        drivers: GeneratedDrivers,
        road: Road | None = None,
        mobil: MobilParameters = TABLE_IV,
    ) -> None:
        super().__init__(generator, drivers, road)
        self.mobil = mobil

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> Memory:
        """See :class:`GeneratedTraffic`; a headway for every driver, residual mean 0."""
        memory = super().fresh_memory(vehicles, key)
        (u,) = uniforms(vehicles, key, -1, Purpose.TRAIT_HEADWAY)
        # Headways as recorded, so that drivers differ as recorded ones do.
        memory["headway"] = headway_from_uniform(u, self.drivers.headways_s)
        memory["residual_mean"] = torch.zeros_like(memory["displacement"])
        return memory

    @torch.no_grad()
    def move(self, vehicles: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        """One :func:`~ganlane.generator.closed_loop.anchored_step`."""
        network = in_dtype(self.generator, vehicles.x.dtype)
        history, noise = self.before(memory, key, step)
        # The washout's mean and the headway belong to the driver, as the history does.
        driver = DriverMemory(history, memory["residual_mean"], memory["headway"])
        anchor = self.drivers.anchor
        # Drivers of this preset have one.
        assert anchor is not None
        # Scaled for the network alone: the memory keeps unit variance.
        latent = self.drivers.noise_scale * noise

        bound = None
        if self.road.stretches:
            # Where lanes end, drivers make room for those who have to leave theirs.
            bound = partial(yielding, idm=self.drivers.idm, mobil=self.mobil)
        moved, driver = anchored_step(network, vehicles, self.road, driver, latent, anchor, bound)

        new_memory = {
            **self.remember(driver.history),
            "noise": noise,
            "residual_mean": driver.mean,
            "headway": driver.headway,
        }
        return moved, new_memory
