"""Fitting the paper's preset, open loop: adversarial, variety, single-sample and mean terms on k-means groups.

Losses after Gupta et al. (2018), with the changes that the fit needs here.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from ganlane.generator.forecasts import paper_forecasts, repeated
from ganlane.generator.loop import descend
from ganlane.generator.networks import DIFFERENCE_SCALE_M, Discriminator, Generator, displacements_of
from ganlane.generator.scores import BASELINE, Metrics, distance, scene_metrics
from ganlane.generator.segments import SceneTracks
from ganlane.generator.windows import Groups, Windows, cut_windows, group_windows
from ganlane.parameters.generator import PaperConfig


def distances(predicted: Tensor, recorded: Tensor) -> Tensor:
    """Distances [..., T] in m between two trajectories given as displacements [..., T, 2]."""
    apart = (predicted - recorded).cumsum(dim=-2)
    return distance(apart, torch.zeros_like(apart))


def variety_loss(errors: Tensor) -> Tensor:
    """Mean error of each vehicle's best sample; ``errors`` is [K, n] in m."""
    return errors.amin(dim=0).mean()


def adversarial_loss(logits: Tensor) -> Tensor:
    """Cross-entropy of classifying generated trajectories as recorded; ln 2 is chance."""
    return binary_cross_entropy_with_logits(logits, torch.ones_like(logits), reduction="none").mean()


def discriminator_loss(recorded: Tensor, generated: Tensor) -> Tensor:
    """Cross-entropy of classifying recorded and generated trajectories by their logits; ln 2 is chance."""
    fake = binary_cross_entropy_with_logits(generated, torch.zeros_like(generated), reduction="none").mean()
    return 0.5 * (adversarial_loss(recorded) + fake)


def discriminator_accuracy(recorded: Tensor, generated: Tensor) -> Tensor:
    """Share of logits with the right sign, both classes with equal weight; 0.5 is chance."""
    return 0.5 * ((recorded > 0).to(recorded.dtype).mean() + (generated <= 0).to(generated.dtype).mean())


class PaperTask:
    """The Social-GAN on windows; see :class:`ganlane.generator.loop.FitTask`."""

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
        _, self.groups = self._grouped_windows(fitted, config.stride)
        self.validation = self._grouped_windows(validation, config.held_out_stride)

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
        windows, groups = self.validation
        mean = paper_forecasts(self.generator, windows, groups, samples=0)["mean"]
        return float(np.linalg.norm(mean - windows.future, axis=-1).mean())

    @torch.no_grad()
    def metrics(self, scenes: list[SceneTracks]) -> Metrics:
        """ADE and FDE of the generator on ``scenes``, all and each, and the discriminator's accuracy on them."""
        windows, groups = self._grouped_windows(scenes, self.config.held_out_stride)
        forecasts = paper_forecasts(self.generator, windows, groups, self.config.seed)
        forecasts[BASELINE] = repeated(windows.past[:, -1], self.config.sizes.predicted)
        logits = self.discriminator(groups.displacements[groups.mask]), self.discriminator(self._samples(groups)[0])
        accuracy = {"held_out_accuracy": float(discriminator_accuracy(*logits))}
        return scene_metrics(windows, forecasts) | {"discriminator": accuracy}

    def _grouped_windows(self, scenes: list[SceneTracks], stride: int) -> tuple[Windows, Groups]:
        """All windows of ``scenes`` and their k-means groups."""
        sizes = self.config.sizes
        windows = cut_windows(scenes, stride, sizes.observed + 1 + sizes.predicted)
        return windows, group_windows(windows, self.config.group_size, self.config.seed)

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
        descend(self.optimisers[name], loss, self.config.loop.largest_gradient)
