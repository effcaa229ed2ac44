"""Fitting the paper's preset, open loop: adversarial, variety, single-sample and mean terms on k-means groups."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ganlane.generator.groups import Groups, group_windows
from ganlane.generator.layers import DIFFERENCE_SCALE_M
from ganlane.generator.loop import descend
from ganlane.generator.losses import (
    adversarial_loss,
    discriminator_accuracy,
    discriminator_loss,
    distances,
    variety_loss,
)
from ganlane.generator.networks import Discriminator, Generator, displacements_of
from ganlane.generator.scores import Metrics, window_errors
from ganlane.generator.windows import SceneTracks, cut_windows
from ganlane.parameters.generator import PaperConfig


class PaperTask:
    """The Social-GAN on windows; see :class:`ganlane.generator.loop.FitTask`.

    Args:
        fitted: scenes to fit to.
        validation: scenes for early stopping.
        config: settings.
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
        self.validation_groups = self._groups(validation, config.held_out_stride)

    def update(self, number: int) -> dict[str, float]:
        """One step of the discriminator, if the adversarial term is on, and one of the generator."""
        groups = self._batch()
        recorded = groups.displacements[groups.mask]
        generated = self._samples(groups, self.config.history_noise)
        losses = {}
        if self.config.weights.adversarial > 0:
            loss = discriminator_loss(self.discriminator(recorded), self.discriminator(generated[0].detach()))
            self._descend("discriminator", loss)
            losses["discriminator"] = float(loss.detach())
        terms = self._generator_terms(recorded, generated)
        weighted = [getattr(self.config.weights, name) * term for name, term in terms.items()]
        self._descend("generator", torch.stack(weighted).sum())
        return losses | {name: float(term.detach()) for name, term in terms.items()}

    def evaluate(self) -> float:
        """ADE of the mean prediction on the validation scenes, m."""
        return window_errors(self.generator, self.validation_groups, self.config.seed)["all"]["ade_m/mean"]

    def metrics(self, scenes: list[SceneTracks]) -> Metrics:
        """ADE and FDE of the generator on ``scenes``, all and each."""
        return window_errors(self.generator, self._groups(scenes, self.config.held_out_stride), self.config.seed)

    @torch.no_grad()
    def discriminator_accuracy(self, scenes: list[SceneTracks]) -> float:
        """How often the discriminator is right about recordings of ``scenes`` and samples; 0.5 is chance."""
        groups = self._groups(scenes, self.config.held_out_stride)
        recorded, generated = groups.displacements[groups.mask], self._samples(groups)[0]
        return float(discriminator_accuracy(self.discriminator(recorded), self.discriminator(generated)))

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

    def _samples(self, groups: Groups, history_noise: float = 0.0) -> Tensor:
        """Recorded past and generated future [K + 1, n, T, 2] of n vehicles: the samples, the mean prediction last.

        Only the pooling needs the padded groups; the decoder runs without padding.
        """
        sizes, mask = self.config.sizes, groups.mask
        past = observed = groups.displacements[..., : sizes.observed, :]
        if history_noise > 0:
            scale = past.new_tensor(DIFFERENCE_SCALE_M)
            observed = past + history_noise * scale * torch.randn(past.shape, generator=self.random)
        observation = self.generator.observe(observed, groups.position, mask)
        context = self.generator.summarise(observation)[mask]
        vehicles = observation._replace(
            displacement=observation.displacement[mask], difference=observation.difference[mask]
        )
        noise = torch.randn(self.config.samples + 1, len(context), sizes.noise, generator=self.random)
        noise[-1] = 0.0
        outputs = self.generator.decode(context, noise, vehicles, sizes.predicted)
        future = displacements_of(outputs, vehicles.displacement)
        return torch.cat([past[mask].expand(len(future), -1, -1, -1), future], dim=-2)

    def _generator_terms(self, recorded: Tensor, generated: Tensor) -> dict[str, Tensor]:
        """Terms of the generator's loss by the names of their weights."""
        observed = self.config.sizes.observed
        errors = distances(generated[..., observed:, :], recorded[..., observed:, :]).mean(-1)
        terms = {"variety": variety_loss(errors[:-1]), "single": errors[:-1].mean(), "mean": errors[-1].mean()}
        if self.config.weights.adversarial > 0:
            terms["adversarial"] = adversarial_loss(self.discriminator(generated[0]))
        return terms

    def _descend(self, name: str, loss: Tensor) -> None:
        descend(self.optimisers[name], loss, self.modules[name], self.config.loop.largest_gradient)
