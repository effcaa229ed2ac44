"""The Social-GAN's two networks (section III; Gupta et al. 2018): generator and discriminator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

from ganlane.generator.layers import DIFFERENCE_SCALE_M, MotionLSTM, PairPooling, apply
from ganlane.parameters.generator import GeneratorSizes


class Observation(NamedTuple):
    """The generator's input for [B, G] vehicles.

    Attributes:
        projections: [B, G, observed - 1, 4H], input projections of the observed motions
            (:meth:`Generator.project`), oldest first. A motion is a displacement and its difference to the one
            before, so 8 displacements are 7 motions. Also accepted: a sequence of tensors [B, G, 4H].
        displacement: [B, G, 2], the last displacement, m per 0.1 s.
        difference: [B, G, 2], its difference to the one before, m.
        position: [B, G, 2], m, relative to any common point.
        valid: [B, G] bool.
        extra: [B, G, extra_inputs].
    """

    projections: Tensor | Sequence[Tensor]
    displacement: Tensor
    difference: Tensor
    position: Tensor
    valid: Tensor
    extra: Tensor


class Generator(nn.Module):
    """Encoder, pooling over pairs, context with noise, decoder.

    The decoder's output is the change of the displacement, a residual on the last one: with an output of 0 it
    predicts constant velocity.
    """

    def __init__(self, sizes: GeneratorSizes):
        super().__init__()
        self.sizes = sizes
        self.encoder = MotionLSTM(sizes.embedding, sizes.hidden, sizes.differences)
        self.pooling = PairPooling(sizes.hidden, sizes.pooling, sizes.pooled, sizes.neighbours)
        inputs = sizes.hidden + sizes.pooled + sizes.extra_inputs
        self.context = nn.Sequential(
            nn.Linear(inputs, sizes.context), nn.ReLU(), nn.Linear(sizes.context, sizes.hidden - sizes.noise)
        )
        self.decoder = MotionLSTM(sizes.embedding, sizes.hidden, sizes.differences)
        self.head = nn.Linear(sizes.hidden, 2)

    def project(self, displacements: Tensor) -> Tensor:
        """Projections [..., T - 1, 4H] of T displacements [..., T, 2]: one for every motion in them."""
        return self.encoder.project(displacements[..., 1:, :], displacements.diff(dim=-2))

    def observe(self, displacements: Tensor, position: Tensor, valid: Tensor) -> Observation:
        """The input from observed displacements [B, G, observed, 2], without further inputs."""
        last, before = displacements[..., -1, :], displacements[..., -2, :]
        extra = last.new_zeros((*last.shape[:-1], 0))
        return Observation(self.project(displacements), last, last - before, position, valid, extra)

    def summarise(self, seen: Observation) -> Tensor:
        """Context [B, G, H - Z] of every vehicle: its own motion, its neighbours, its further inputs."""
        hidden = self.encoder.encode(seen.projections)
        pooled = self.pooling(hidden, seen.position, seen.displacement, seen.valid)
        first, second = (cast(nn.Linear, self.context[index]) for index in (0, 2))
        return apply(second, apply(first, torch.cat([hidden, pooled, seen.extra], dim=-1), relu=True))

    def decode(self, context: Tensor, noise: Tensor, seen: Observation, steps: int) -> Tensor:
        """Output of the decoder's first ``steps`` steps [..., steps, 2], in units of ``DIFFERENCE_SCALE_M``.

        ``context`` is [..., H - Z] and ``noise`` [..., Z]; leading dimensions broadcast, so that several
        samples share one context. Each output is the change of the displacement that the next step continues.
        """
        leading = torch.broadcast_shapes(context.shape[:-1], noise.shape[:-1])
        hidden = torch.cat([context.expand(*leading, -1), noise.expand(*leading, -1)], dim=-1)
        cell = torch.zeros_like(hidden)
        scale = hidden.new_tensor(DIFFERENCE_SCALE_M)
        displacement, difference, outputs = seen.displacement, seen.difference, []
        for _ in range(steps):
            hidden, cell = self.decoder.step(self.decoder.project(displacement, difference), hidden, cell)
            outputs.append(apply(self.head, hidden))
            difference = outputs[-1] * scale
            displacement = displacement + difference
        return torch.stack(outputs, dim=-2)

    def forward(self, seen: Observation, noise: Tensor, steps: int | None = None) -> Tensor:
        """Predicted displacements [..., steps, 2], m per 0.1 s, for ``noise`` [..., B, G, Z]; all by default."""
        outputs = self.decode(self.summarise(seen), noise, seen, self.sizes.predicted if steps is None else steps)
        return displacements_of(outputs, seen.displacement)


def displacements_of(outputs: Tensor, last: Tensor) -> Tensor:
    """Displacements [..., steps, 2] that follow ``last`` [..., 2] when it changes by the decoder's outputs."""
    return last[..., None, :] + outputs.cumsum(dim=-2) * outputs.new_tensor(DIFFERENCE_SCALE_M)


class Discriminator(nn.Module):
    """Classifies displacements as recorded or generated; outputs a logit (the original's ReLU cannot say 'fake')."""

    def __init__(self, embedding: int = 64, hidden: int = 32):
        super().__init__()
        self.encoder = MotionLSTM(embedding, hidden)
        self.head = nn.Sequential(nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 1))

    def forward(self, displacements: Tensor) -> Tensor:
        """Logits [...] that the observed and following displacements [..., T, 2] were recorded."""
        projections = self.encoder.project(displacements[..., 1:, :], displacements.diff(dim=-2))
        return self.head(self.encoder.encode(projections)).squeeze(-1)
