"""Fitting the paper's preset: adversarial, variety, single-sample and mean terms on k-means groups."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from ganlane.generator.groups import Groups, group_windows
from ganlane.generator.losses import (
    LossWeights,
    adversarial_loss,
    discriminator_accuracy,
    discriminator_loss,
    distances,
    masked_mean,
    variety_loss,
)
from ganlane.generator.lstm import DIFFERENCE_SCALE_M
from ganlane.generator.metrics import Metrics, open_loop
from ganlane.generator.networks import Discriminator, Generator, GeneratorSizes, displacements_of
from ganlane.generator.schedule import LoopConfig, descend
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
        held_out_stride: the same on the scenes that choose when to stop and on those that are reported.
        history_noise: in fitting, standard deviation of noise on the observed displacements, in units of a typical
            difference (0.04 m along and 0.02 m across the road); 0 shows them as they were recorded.
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
    history_noise: float = 0.0
    batch: int = 48
    mirror: bool = True
    seed: int = 0


class PaperTask:
    """The Social-GAN on windows; see :class:`ganlane.generator.loop.FitTask`.

    Args:
        fitted: scenes to fit to.
        validation: scenes that choose when to stop.
        config: how.
    """

    def __init__(self, fitted: list[SceneTracks], validation: list[SceneTracks], config: PaperConfig):
        torch.manual_seed(config.seed)
        self.config = config
        self.generator = Generator(config.sizes)
        self.discriminator = Discriminator(config.sizes.embedding, config.sizes.hidden)
        self.modules: dict[str, nn.Module] = {"generator": self.generator, "discriminator": self.discriminator}
        self.optimisers: dict[str, torch.optim.Optimizer] = {
            name: torch.optim.Adam(module.parameters()) for name, module in self.modules.items()
        }
        self.random = torch.Generator().manual_seed(config.seed)
        self.groups = self._groups(fitted, config.stride)
        self.validation = validation
        self.validation_groups = self._groups(validation, config.held_out_stride)

    def update(self, number: int) -> dict[str, float]:
        """One step of the discriminator, when it counts, and one of the generator."""
        groups = self._batch()
        recorded = groups.displacements[groups.mask]
        generated = self._sample(groups, self.config.history_noise)
        losses = {}
        if self.config.weights.adversarial > 0:
            losses["discriminator"] = self._teach_discriminator(recorded, generated[0].detach())
        loss, terms = self._generator_loss(recorded, generated)
        descend(self.optimisers["generator"], loss, self.generator, self.config.loop.largest_gradient)
        return losses | {name: float(term.detach()) for name, term in terms.items()}

    def evaluate(self) -> float:
        """ADE of the mean prediction on the validation scenes, m."""
        names = tuple(scene.name for scene in self.validation)
        return open_loop(self.generator, self.validation_groups, names, self.config.seed)["all"]["ade_m/mean"]

    def metrics(self, scenes: list[SceneTracks]) -> Metrics:
        """ADE and FDE on ``scenes``, all and each."""
        names = tuple(scene.name for scene in scenes)
        return open_loop(self.generator, self._groups(scenes, self.config.held_out_stride), names, self.config.seed)

    @torch.no_grad()
    def discriminator_accuracy(self, scenes: list[SceneTracks]) -> float:
        """How often the discriminator tells the recordings of ``scenes`` from samples; 0.5 is chance."""
        groups = self._groups(scenes, self.config.held_out_stride)
        recorded, generated = groups.displacements[groups.mask], self._sample(groups)[0]
        logits = self.discriminator(recorded), self.discriminator(generated)
        return float(discriminator_accuracy(*logits, everybody(recorded)))

    def _groups(self, scenes: list[SceneTracks], stride: int) -> Groups:
        """k-means groups of all windows of ``scenes``."""
        sizes = self.config.sizes
        windows = cut_windows(scenes, stride, sizes.observed + 1 + sizes.predicted)
        return group_windows(windows, self.config.group_size, self.config.seed)

    def _batch(self) -> Groups:
        rows = torch.randint(len(self.groups), (self.config.batch,), generator=self.random)
        groups = self.groups.select(rows)
        if not self.config.mirror:
            return groups
        return groups.mirrored(torch.rand(len(groups), generator=self.random) < 0.5)

    def _sample(self, groups: Groups, history_noise: float = 0.0) -> Tensor:
        """Recorded past and generated future [K + 1, n, T, 2] of n vehicles: the samples, the mean prediction last.

        Only the pooling needs the padded groups; the decoder runs on the vehicles that there are.
        """
        sizes, mask = self.config.sizes, groups.mask
        past = shown = groups.displacements[..., : sizes.observed, :]
        if history_noise > 0:
            scale = past.new_tensor(DIFFERENCE_SCALE_M)
            shown = past + history_noise * scale * torch.randn(past.shape, generator=self.random)
        seen = self.generator.observe(shown, groups.position, mask)
        context = self.generator.summarise(seen)[mask]
        vehicles = seen._replace(displacement=seen.displacement[mask], difference=seen.difference[mask])
        noise = torch.randn(self.config.samples + 1, len(context), sizes.noise, generator=self.random)
        noise[-1] = 0.0
        outputs = self.generator.decode(context, noise, vehicles, sizes.predicted)
        future = displacements_of(outputs, vehicles.displacement)
        return torch.cat([past[mask].expand(len(future), -1, -1, -1), future], dim=-2)

    def _teach_discriminator(self, recorded: Tensor, generated: Tensor) -> float:
        loss = discriminator_loss(self.discriminator(recorded), self.discriminator(generated), everybody(recorded))
        descend(self.optimisers["discriminator"], loss, self.discriminator, self.config.loop.largest_gradient)
        return float(loss.detach())

    def _generator_loss(self, recorded: Tensor, generated: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        weights, observed, who = self.config.weights, self.config.sizes.observed, everybody(recorded)
        errors = distances(generated[..., observed:, :], recorded[..., observed:, :]).mean(-1)
        terms = {
            "variety": variety_loss(errors[:-1], who),
            "single": masked_mean(errors[:-1], who),
            "mean": masked_mean(errors[-1], who),
        }
        if weights.adversarial > 0:
            terms["adversarial"] = adversarial_loss(self.discriminator(generated[0]), who)
        return torch.stack([getattr(weights, name) * term for name, term in terms.items()]).sum(), terms


def everybody(vehicles: Tensor) -> Tensor:
    """A mask [n] that leaves none of ``vehicles`` [n, ...] out."""
    return torch.ones(len(vehicles), dtype=torch.bool)
