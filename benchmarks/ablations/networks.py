"""Generators that are no option of the package: one in bfloat16, and one that follows plans of several steps.

Of the generator in bfloat16 layers and states are; positions and displacements that are driven stay float32.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.generator import Generator
from ganlane.generator.networks import MotionLSTM, Observation, PairPooling, motion_features


class Bfloat16Motion(MotionLSTM):
    """Projections in bfloat16; so are the recurrence and its state."""

    def project(self, displacement: Tensor, difference: Tensor) -> Tensor:
        """See :meth:`MotionLSTM.project`."""
        return self.input(torch.relu(self.embed(motion_features(displacement, difference).bfloat16())))


class Bfloat16Pooling(PairPooling):
    """Positions are made relative to the first vehicle before they lose digits (0.25 m at 60 m)."""

    def forward(self, hidden: Tensor, position: Tensor, displacement: Tensor, valid: Tensor) -> Tensor:
        """See :meth:`PairPooling.forward`."""
        near = (position - position[..., :1, :]).bfloat16()
        return super().forward(hidden, near, displacement.bfloat16(), valid)


class Bfloat16Generator(Generator):
    """``generator`` with its layers in bfloat16; its output is float32."""

    def __init__(self, generator: Generator) -> None:
        sizes = generator.sizes
        super().__init__(sizes)
        self.encoder = Bfloat16Motion(sizes.embedding, sizes.hidden)
        self.decoder = Bfloat16Motion(sizes.embedding, sizes.hidden)
        self.pooling = Bfloat16Pooling(sizes.hidden, sizes.pooling, sizes.pooled, sizes.neighbours)
        self.load_state_dict(generator.state_dict())
        self.bfloat16().eval().requires_grad_(False)

    def summarise(self, now: Observation) -> Tensor:
        """See :meth:`Generator.summarise`."""
        return super().summarise(now._replace(extra=now.extra.bfloat16()))

    def decode(self, context: Tensor, noise: Tensor, now: Observation, steps: int) -> Tensor:
        """See :meth:`Generator.decode`."""
        return super().decode(context, noise.bfloat16(), now, steps).float()


class PlanningGenerator(Generator):
    """``generator`` asked for one step at a time, but looking only every ``steps``: what execute_k is to ``gan``."""

    def __init__(self, generator: Generator, steps: int) -> None:
        super().__init__(generator.sizes)
        self.load_state_dict(generator.state_dict())
        self.eval().requires_grad_(False)
        self.steps, self.ahead = steps, list[Tensor]()

    def summarise(self, now: Observation) -> Tensor:
        """The context; nothing while the plan lasts."""
        return now.displacement if self.ahead else super().summarise(now)

    def decode(self, context: Tensor, noise: Tensor, now: Observation, steps: int) -> Tensor:
        """The next step of the plan [..., 1, 2]; all rows began together, so all look at the same time."""
        if not self.ahead:
            self.ahead = list(super().decode(context, noise, now, self.steps).unbind(-2))
        return self.ahead.pop(0)[..., None, :]
