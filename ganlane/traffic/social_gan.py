"""Traffic driven by the generator: the paper's preset, and the calibrated one.

Both follow ``vehicles.target_lane`` (the calibrated one) or their own mind (the paper's); lane changes drawn at
random, random accelerations and the guard are overlays of their own. The ego is a neighbour like any other.

A vehicle that enters, at the start of an episode or when it is put back in front, has always driven straight
along its lane at its present speed: that is how its history is filled. Its latent vector is drawn at the same
time and then wanders, with a memory of its own for every vehicle.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.errors import UserError
from ganlane.generator.anchored import ANCHOR, EXTRA_INPUTS, AnchorParameters, DriverMemory, anchored_step
from ganlane.generator.history import History, start
from ganlane.generator.networks import Generator
from ganlane.generator.noise import wander
from ganlane.generator.paper import Plan, paper_step
from ganlane.generator.traits import HEADWAY_QUANTILES_S, headway_from_uniform
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.lanes import Visibility
from ganlane.sim.random import Purpose, Stream, normal, uniform
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


class SocialGanTraffic(GeneratedTraffic):
    """``traffic=gan``: the paper's preset. Positions only; the first predicted displacement moves the vehicle.

    Knows neither lanes nor road: on its own the closed loop drifts (design, section 4), so a guard belongs
    behind it.

    Args:
        execute_k: predicted displacements that are driven before predicting again, 1 (the paper) to 8. With
            more than 1 memory also holds ``plan`` [N, M, execute_k, 2] in m and ``plan_left`` [N, M].

    Raises:
        UserError: ``execute_k`` is out of range; see also :class:`GeneratedTraffic`.
    """

    def __init__(
        self,
        generator: Generator,
        road: Road | None = None,
        stream: int = Stream.TRAIN,
        noise_period_s: float = 5.0,
        noise_scale: float = 1.0,
        execute_k: int = 1,
    ) -> None:
        super().__init__(generator, road, stream, noise_period_s, noise_scale)
        if not 1 <= execute_k <= generator.sizes.predicted:
            raise UserError(
                f"execute_k={execute_k}: the generator predicts {generator.sizes.predicted} steps; choose 1 to "
                f"{generator.sizes.predicted}."
            )
        self.execute_k = execute_k

    @property
    def memory_fields(self) -> MemoryFields:  # type: ignore[override]
        """Trailing shapes of the memory."""
        if self.execute_k == 1:
            return super().memory_fields
        return {**super().memory_fields, "plan": ((self.execute_k, 2), None), "plan_left": ((), torch.int64)}

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> dict[str, Tensor]:
        """See :class:`GeneratedTraffic`; no plan is left."""
        memory = super().fresh_memory(vehicles, key)
        if self.execute_k > 1:
            memory["plan"] = memory["displacement"][..., None, :].repeat(1, 1, self.execute_k, 1)
            memory["plan_left"] = torch.zeros_like(vehicles.target_lane)
        return memory

    @torch.no_grad()
    def move(self, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor) -> tuple[Vehicles, dict]:
        """Predict, and drive the first displacement (or what is left of the plan)."""
        noise = self.next_noise(memory, key, step)
        plan = Plan(memory["plan"], memory["plan_left"]) if self.execute_k > 1 else None
        history = self.history(memory)
        moved, history, plan = paper_step(self.generator, vehicles, history, self.noise_scale * noise, plan)
        kept = {**self.kept(history), "noise": noise}
        return moved, kept if plan is None else {**kept, "plan": plan.ahead, "plan_left": plan.left}


class AnchoredGanTraffic(GeneratedTraffic):
    """``traffic=gan_calibrated``: IDM and lane keeping as an anchor, the network's residual on it, traits per driver.

    Memory, beside :class:`GeneratedTraffic`'s: ``residual_mean`` [N, M, 2] in m/s2 (the washout), ``headway``
    [N, M] in s. The desired speed is ``vehicles.desired_speed``; ``vehicles.target_lane`` is followed.

    Args:
        headway_quantiles_s: 5, 25, 50, 75 and 95 % quantiles that the drivers' headways are drawn from.
        anchor: its parameters.
    """

    extra_inputs = EXTRA_INPUTS

    def __init__(
        self,
        generator: Generator,
        road: Road | None = None,
        stream: int = Stream.TRAIN,
        noise_period_s: float = 5.0,
        noise_scale: float = 1.0,
        headway_quantiles_s: tuple[float, ...] = HEADWAY_QUANTILES_S,
        anchor: AnchorParameters = ANCHOR,
    ) -> None:
        super().__init__(generator, road, stream, noise_period_s, noise_scale)
        self.headway_quantiles_s, self.anchor = headway_quantiles_s, anchor

    @property
    def memory_fields(self) -> MemoryFields:  # type: ignore[override]
        """Trailing shapes of the memory."""
        return {**super().memory_fields, "residual_mean": ((2,), None), "headway": ((), None)}

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> dict[str, Tensor]:
        """See :class:`GeneratedTraffic`; a headway for every driver, and no residual yet."""
        memory = super().fresh_memory(vehicles, key)
        u = uniform(key, -1, vehicles.x.shape[1], [Purpose.TRAIT_HEADWAY], vehicles.x.dtype)[..., 0]
        memory["headway"] = headway_from_uniform(u, self.headway_quantiles_s)
        memory["residual_mean"] = torch.zeros_like(memory["displacement"])
        return memory

    @torch.no_grad()
    def move(self, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor) -> tuple[Vehicles, dict]:
        """One :func:`~ganlane.generator.anchored.anchored_step`."""
        noise = self.next_noise(memory, key, step)
        driver = DriverMemory(self.history(memory), memory["residual_mean"], memory["headway"])
        moved, driver = anchored_step(
            self.generator, vehicles, self.road, driver, self.noise_scale * noise, self.anchor
        )
        return moved, {
            **self.kept(driver.history),
            "noise": noise,
            "residual_mean": driver.mean,
            "headway": driver.headway,
        }
