"""Traffic driven by the paper's generator.

It follows its own mind; lane changes drawn at random, random accelerations and the guard are overlays of their own.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.errors import UserError
from ganlane.generator.closed_loop import Plan, paper_step
from ganlane.generator.networks import Generator
from ganlane.sim.random import Stream
from ganlane.sim.road import Road
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import MemoryFields
from ganlane.traffic.generated import GeneratedTraffic


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
