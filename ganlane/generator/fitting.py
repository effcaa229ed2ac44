"""Fitting the paper's preset: adversarial, variety, single-sample and mean terms on k-means groups."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from ganlane.generator.groups import Groups, group_windows
from ganlane.generator.loop import LoopConfig, descend
from ganlane.generator.losses import (
    LossWeights,
    adversarial_loss,
    discriminator_accuracy,
    discriminator_loss,
    distances,
    masked_mean,
    variety_loss,
)
from ganlane.generator.metrics import Metrics, open_loop
from ganlane.generator.networks import Discriminator, Generator, GeneratorSizes
from ganlane.generator.tracks import SceneTracks
from ganlane.generator.windows import cut_windows


@dataclass(frozen=True)
class PaperConfig:
    """What the paper's preset is fitted with.

    Attributes:
        sizes: of the generator.
        weights: of the loss terms.
        loop: how long.
        group_size: vehicles per k-means group, about.
        stride: frames between the starts of two windows, in fitting.
        held_out_stride: the same on the held-out scenes.
        samples: samples per update, of which the best counts in the variety term.
        batch: groups per update.
        mirror: swap left and right in half of the groups.
        seed: of weights, batches, noise and k-means.
    """

    sizes: GeneratorSizes = field(default_factory=GeneratorSizes)
    weights: LossWeights = field(default_factory=LossWeights)
    loop: LoopConfig = field(default_factory=LoopConfig)
    group_size: int = 9
    stride: int = 1
    held_out_stride: int = 3
    samples: int = 6
    batch: int = 48
    mirror: bool = True
    seed: int = 0


class PaperTask:
    """The Social-GAN on windows; see :class:`ganlane.generator.loop.FitTask`."""

    def __init__(self, fitted: list[SceneTracks], held_out: list[SceneTracks], config: PaperConfig):
        torch.manual_seed(config.seed)
        self.config = config
        self.generator = Generator(config.sizes)
        self.discriminator = Discriminator(config.sizes.embedding, config.sizes.hidden)
        self.modules: dict[str, nn.Module] = {"generator": self.generator, "discriminator": self.discriminator}
        self.optimisers: dict[str, torch.optim.Optimizer] = {
            name: torch.optim.Adam(module.parameters()) for name, module in self.modules.items()
        }
        self.random = torch.Generator().manual_seed(config.seed)
        self.groups = group_windows(cut_windows(fitted, config.stride), config.group_size, config.seed)
        self.held_out = group_windows(cut_windows(held_out, config.held_out_stride), config.group_size, config.seed)
        self.held_out_names = tuple(scene.name for scene in held_out)

    def update(self, number: int) -> dict[str, float]:
        """One step of the discriminator, when it counts, and one of the generator."""
        groups = self._batch()
        recorded = groups.displacements
        generated = self._sample(groups)
        losses = {}
        if self.config.weights.adversarial > 0:
            losses["discriminator"] = self._teach_discriminator(recorded, generated[0].detach(), groups.mask)
        loss, terms = self._generator_loss(recorded, generated, groups.mask)
        descend(self.optimisers["generator"], loss, self.generator, self.config.loop.largest_gradient)
        return losses | {name: float(term.detach()) for name, term in terms.items()}

    def evaluate(self) -> float:
        """ADE of the mean prediction on the held-out scenes, m."""
        return self.metrics()["all"]["ade_m/mean"]

    def metrics(self) -> Metrics:
        """ADE and FDE on the held-out scenes, all and each."""
        return open_loop(self.generator, self.held_out, self.held_out_names, self.config.seed)

    @torch.no_grad()
    def held_out_accuracy(self) -> float:
        """How often the discriminator tells held-out recordings from samples; 0.5 is chance."""
        groups = self.held_out
        generated = self._sample(groups)[0]
        logits = self.discriminator(groups.displacements), self.discriminator(generated)
        return float(discriminator_accuracy(*logits, groups.mask))

    def _batch(self) -> Groups:
        rows = torch.randint(len(self.groups), (self.config.batch,), generator=self.random)
        groups = self.groups.select(rows)
        if not self.config.mirror:
            return groups
        return groups.mirrored(torch.rand(len(groups), generator=self.random) < 0.5)

    def _sample(self, groups: Groups) -> Tensor:
        """Recorded past and generated future [1 + K, B, G, T, 2]: the samples, and the mean prediction last."""
        sizes = self.config.sizes
        past = groups.displacements[..., : sizes.observed, :]
        seen = self.generator.observe(past, groups.position, groups.mask)
        noise = torch.randn(self.config.samples + 1, *groups.mask.shape, sizes.noise, generator=self.random)
        future = self.generator(seen, torch.cat([noise[:-1], torch.zeros_like(noise[-1:])]))
        return torch.cat([past.expand(len(future), *past.shape), future], dim=-2)

    def _teach_discriminator(self, recorded: Tensor, generated: Tensor, mask: Tensor) -> float:
        loss = discriminator_loss(self.discriminator(recorded), self.discriminator(generated), mask)
        descend(self.optimisers["discriminator"], loss, self.discriminator, self.config.loop.largest_gradient)
        return float(loss.detach())

    def _generator_loss(self, recorded: Tensor, generated: Tensor, mask: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        weights, observed = self.config.weights, self.config.sizes.observed
        errors = distances(generated[..., observed:, :], recorded[..., observed:, :]).mean(-1)
        terms = {
            "variety": variety_loss(errors[:-1], mask),
            "single": masked_mean(errors[:-1], mask),
            "mean": masked_mean(errors[-1], mask),
        }
        if weights.adversarial > 0:
            terms["adversarial"] = adversarial_loss(self.discriminator(generated[0]), mask)
        return torch.stack([getattr(weights, name) * term for name, term in terms.items()]).sum(), terms
