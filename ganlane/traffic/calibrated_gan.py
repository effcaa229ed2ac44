"""Traffic driven by the calibrated generator: a residual on an anchor of IDM and lane keeping.

It follows ``vehicles.target_lane``; lane changes are drawn by an overlay of their own.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.generator.closed_loop import ANCHOR, AnchorParameters, DriverMemory, anchored_step
from ganlane.generator.networks import Generator
from ganlane.generator.rollout import HEADWAY_QUANTILES_S, headway_from_uniform
from ganlane.parameters.generator import EXTRA_INPUTS
from ganlane.sim.random import Purpose, Stream, uniform
from ganlane.sim.road import Road
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import MemoryFields
from ganlane.traffic.generated import GeneratedTraffic


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
        """One :func:`~ganlane.generator.closed_loop.anchored_step`."""
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
