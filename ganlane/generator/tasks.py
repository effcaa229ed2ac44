"""What is fitted: the losses, updates and scores of each preset, and the loop that runs them.

**paper**, open loop: adversarial, variety, single-sample and mean terms on k-means groups of
windows. Losses after Gupta et al. (2018), with the changes that the fit needs here.

**calibrated**: joint rollouts of whole scenes. Updates with z = 0, whose loss is the error,
alternate with updates of two samples, whose loss is the energy score; both are divided, step by
step, by the error of constant velocity.

**human**: cloning, closed loop and fine-tuning (:mod:`ganlane.generator.human_fit`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from ganlane.data.dense import Recording
from ganlane.generator.closed_loop import driver_params, noise_shape, rollout
from ganlane.generator.descent import descend, half_cosine
from ganlane.generator.forecasts import (
    calibrated_driver,
    distance,
    driven_windows,
    energy_score,
    mean_by_step,
    paper_forecasts,
    rollout_score,
)
from ganlane.generator.human_estimator import HumanModel
from ganlane.generator.human_fit import fit_human, fit_steps
from ganlane.generator.human_forecasts import WIDTH_M, fit_observer, human_driver
from ganlane.generator.networks import Discriminator, Generator, displacements_of
from ganlane.generator.windows import (
    Groups,
    Segments,
    Windows,
    cut_segments,
    cut_windows,
    group_windows,
    segment_starts,
)
from ganlane.settings.generator import CalibratedConfig, HumanConfig, PaperConfig


def cross_entropy(logits: Tensor, recorded: float) -> Tensor:
    """Mean cross-entropy of classifying trajectories by their logits; ln 2 is chance.

    They are recorded (1) or generated (0).
    """
    labels = torch.full_like(logits, recorded)
    return binary_cross_entropy_with_logits(logits, labels, reduction="none").mean()


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of ``values`` where ``mask`` (broadcast) is true; 0 if it is nowhere."""
    # At least one, so that an empty mask gives 0 instead of NaN.
    weight = mask.expand_as(values).to(values.dtype)
    return (values * weight).sum() / weight.sum().clamp_min(1.0)


class _Task(nn.Module):
    """A generator and its random numbers, to which a task adds other networks and the data.

    Every network has an optimiser of its own.
    """

    def __init__(self, config: PaperConfig | CalibratedConfig):
        super().__init__()
        # The networks' first weights come from torch's own generator, all else from ``random``.
        torch.manual_seed(config.seed)
        self.generator = Generator(config.sizes)
        # Adam's default rate is a placeholder: the loop sets the rate before every update.
        self.optimisers = {"generator": torch.optim.Adam(self.generator.parameters())}
        self.random = torch.Generator().manual_seed(config.seed)
        self.loop = config.loop

    def update(self, number: int) -> dict[str, float]:
        """One update; its losses."""
        raise NotImplementedError

    def evaluate(self) -> float:
        """The score on the validation scenes; lower is better."""
        raise NotImplementedError

    def fit(self, name: str, on_progress: OnProgress) -> int:
        """Update until the score improves no more, and take the best weights.

        Returns:
            Updates until the best evaluation on the validation scenes.
        """
        loop = self.loop
        best, best_update, waited = math.inf, 0, 0
        best_weights: dict[str, Tensor] = {}
        score = None
        for done in range(1, loop.updates + 1):
            # A linear warm-up, then a half cosine to 0.
            rate = loop.learning_rate * min(1.0, done / max(1, loop.warmup))
            for optimiser in self.optimisers.values():
                optimiser.param_groups[0]["lr"] = rate * half_cosine(done - 1, loop.updates)
            losses = self.update(done - 1)
            if done % loop.evaluate_every == 0 or done == loop.updates:
                score = self.evaluate()
                waited += 1
                if score < best:
                    best, best_update, waited = score, done, 0
                    # A copy, since the next updates change the networks' own tensors.
                    best_weights = deepcopy(self.state_dict())
            on_progress(Progress(name, done, loop.updates, losses, score, best))
            if waited >= loop.patience:
                break
        # Empty if no evaluation gave a finite score.
        if best_weights:
            self.load_state_dict(best_weights)
        return best_update

    def descend(self, network: str, loss: Tensor) -> float:
        """One step of a network down its ``loss``, whose value is returned."""
        return descend(self.optimisers[network], loss, self.loop.largest_gradient)


class PaperTask(_Task):
    """The Social-GAN on windows."""

    def __init__(self, fitted: list[Recording], validation: list[Recording], config: PaperConfig):
        super().__init__(config)
        self.config = config
        self.discriminator = Discriminator(config.sizes.embedding, config.sizes.hidden)
        self.optimisers["discriminator"] = torch.optim.Adam(self.discriminator.parameters())
        _, self.groups = self._grouped_windows(fitted, config.stride)
        self.validation = self._grouped_windows(validation, config.held_out_stride)

    def update(self, number: int) -> dict[str, float]:
        """One step of the generator, and of the discriminator if the adversarial term is on."""
        config = self.config
        rows = torch.randint(len(self.groups), (config.batch,), generator=self.random)
        # Left and right are alike on a motorway, so mirrored groups are as good as recorded ones.
        groups = self.groups.select(rows)
        groups = groups.mirrored(torch.rand(len(groups), generator=self.random) < 0.5)
        # [n, T, 2]: vehicles of all groups, without padding.
        recorded = groups.displacements[groups.mask]
        generated = self._samples(groups)

        # The discriminator learns from one sample, which carries no gradient to the generator.
        losses = {}
        if config.weights.adversarial > 0:
            real = self.discriminator(recorded)
            fake = self.discriminator(generated[0].detach())
            loss = 0.5 * (cross_entropy(real, 1.0) + cross_entropy(fake, 0.0))
            losses["discriminator"] = self.descend("discriminator", loss)

        # The generator: what it predicted, in all samples and for z = 0 (the last).
        missed = (generated - recorded)[..., config.sizes.observed :, :]
        # Positions are the sums of displacements.
        apart = missed.cumsum(dim=-2)
        errors = distance(apart, torch.zeros_like(apart)).mean(-1)
        terms = {
            # Only the best of each vehicle's samples counts.
            "variety": errors[:-1].amin(dim=0).mean(),
            "single": errors[:-1].mean(),
            "mean": errors[-1].mean(),
        }
        if config.weights.adversarial > 0:
            terms["adversarial"] = cross_entropy(self.discriminator(generated[0]), 1.0)
        # The terms' names are those of their weights.
        weighted = [getattr(config.weights, name) * term for name, term in terms.items()]
        self.descend("generator", torch.stack(weighted).sum())
        return losses | {name: float(term.detach()) for name, term in terms.items()}

    def evaluate(self) -> float:
        """ADE of the mean prediction on the validation scenes, m."""
        windows, groups = self.validation
        (mean,) = paper_forecasts(self.generator, windows, groups, self.config.seed, 0)
        return float(np.linalg.norm(mean - windows.future, axis=-1).mean())

    def forecasts(
        self, scenes: list[Recording], steps: int, stride: int, samples: int
    ) -> np.ndarray:
        """Forecasts [1 + K, W, T, 2] of the windows of ``scenes``; the first is the mean one."""
        windows, groups = self._grouped_windows(scenes, stride)
        return paper_forecasts(self.generator, windows, groups, self.config.seed, samples)

    def _grouped_windows(self, scenes: list[Recording], stride: int) -> tuple[Windows, Groups]:
        """All windows of ``scenes`` and their k-means groups."""
        sizes = self.config.sizes
        # n displacements need n + 1 positions.
        windows = cut_windows(scenes, stride, sizes.observed + 1 + sizes.predicted)
        return windows, group_windows(windows, self.config.group_size, self.config.seed)

    def _samples(self, groups: Groups) -> Tensor:
        """Recorded past and generated future [K + 1, n, T, 2] of n vehicles.

        The samples come first, the mean prediction last. Only the pooling needs the padded groups;
        the decoder runs without padding.
        """
        sizes = self.config.sizes
        mask = groups.mask
        past = groups.displacements[..., : sizes.observed, :]
        observation = self.generator.observe(past, groups.position, mask)
        context = self.generator.summarise(observation)[mask]

        # [B, G, ...] -> [n, ...]: from here on without padding.
        vehicles = observation._replace(
            displacement=observation.displacement[mask], difference=observation.difference[mask]
        )
        shape = (self.config.samples + 1, len(context), sizes.noise)
        noise = torch.randn(shape, generator=self.random)
        # The mean driver.
        noise[-1] = 0.0
        outputs = self.generator.decode(context, noise, vehicles, sizes.predicted)
        future = displacements_of(outputs, vehicles.displacement)
        return torch.cat([past[mask].expand(len(future), -1, -1, -1), future], dim=-2)


class CalibratedTask(_Task):
    """The anchored generator on whole scenes."""

    def __init__(
        self, fitted: list[Recording], validation: list[Recording], config: CalibratedConfig
    ):
        super().__init__(config)
        self.config = config
        self.validation = validation
        # Every segment has room for the longest horizon; a shorter one uses its beginning.
        longest = max(config.horizons)
        cuts = [(scene, row) for scene in fitted for row in segment_starts(scene, longest)]
        #: All possible segments, sorted by their vehicles, so that neighbours need little padding.
        self.cuts = sorted(cuts, key=lambda cut: int(cut[0].present[cut[1]].sum()))
        # Some 64 of them, evenly spread, measure constant velocity well enough.
        segments = cut_segments(self.cuts[:: max(1, len(self.cuts) // 64)], longest)
        #: Mean error [H] in m of constant velocity on the fitted scenes.
        errors = distance(segments.constant_velocity, segments.future)
        self.scale = mean_by_step([(errors, segments.scored)])

    def update(self, number: int) -> dict[str, float]:
        """One rollout of a batch of segments and one step.

        Even updates fit the mean driver (z = 0), odd ones two samples.
        """
        config = self.config
        segments = self._batch()
        drivers = driver_params(segments, self.random)
        # The energy score needs two samples, the mean error one.
        sampled = number % 2 == 1
        shape = noise_shape(self.generator, segments, 2 if sampled else 1)
        noise = torch.randn(shape, generator=self.random) if sampled else torch.zeros(shape)
        positions = rollout(self.generator, segments, drivers, noise, config)
        if sampled:
            losses = energy_score(positions[0], positions[1], segments.future)
        else:
            losses = distance(positions[0], segments.future)
        # Late steps err most, so each is measured by what constant velocity errs there.
        loss = masked_mean(losses / self.scale[: losses.shape[1], None], segments.scored)
        return {"energy" if sampled else "mean": self.descend("generator", loss)}

    def evaluate(self) -> float:
        """The score of rollouts through the validation scenes."""
        return rollout_score(self.generator, self.validation, self.config)

    def forecasts(
        self, scenes: list[Recording], steps: int, stride: int, samples: int
    ) -> np.ndarray:
        """Forecasts [1 + K, W, T, 2] of the windows of ``scenes``; the first is the mean one."""
        driver = calibrated_driver(self.generator, self.config, samples)
        return driven_windows(driver, scenes, steps, stride, 1 + samples)

    def _batch(self) -> Segments:
        """Segments with similar numbers of vehicles over a random horizon.

        They are mirrored in half of the updates.
        """
        shares = torch.tensor(self.config.shares, dtype=torch.float32)
        horizon = self.config.horizons[int(torch.multinomial(shares, 1, generator=self.random))]

        # Random ones among neighbours in the order of their size.
        span = min(len(self.cuts), 8 * self.config.batch)
        begin = int(torch.randint(len(self.cuts) - span + 1, (), generator=self.random))
        rows = torch.randperm(span, generator=self.random)[: self.config.batch] + begin
        segments = cut_segments([self.cuts[row] for row in rows.tolist()], horizon)

        flip = float(torch.rand((), generator=self.random)) < 0.5
        return segments.mirrored() if flip else segments


class HumanTask(nn.Module):
    """A policy, fitted for a fixed schedule: no scene stops it early.

    ``following`` are cars that follow each other in one lane.
    """

    def __init__(
        self, scenes: list[Recording], following: Sequence[Recording], config: HumanConfig
    ):
        super().__init__()
        self.config = config
        self.scenes = scenes
        self.following = following
        # The fit draws its own first weights; these must not change the caller's random numbers.
        with torch.random.fork_rng(devices=[]):
            self.generator = HumanModel(config.sizes)

    def fit(self, name: str, on_progress: OnProgress) -> int:
        """Fit the policy; the steps that were made."""
        steps = fit_steps(self.config)
        done, best = 0, math.inf

        def report(cost: float | None) -> None:
            nonlocal done, best
            done += 1
            best = best if cost is None else min(best, cost)
            on_progress(Progress(name, done, steps, {}, cost, best))

        # In forecasts no width is known.
        scenes = [replace(scene, width=np.full_like(scene.width, WIDTH_M)) for scene in self.scenes]
        self.generator = fit_human(self.config, scenes, self.following, report)
        fit_observer(self.generator, self.scenes, self.config)
        return steps

    def forecasts(
        self, scenes: list[Recording], steps: int, stride: int, samples: int
    ) -> np.ndarray:
        """Forecasts [1 + K, W, T, 2] of the windows of ``scenes``; the first is the mean one."""
        driver = human_driver(self.generator, samples)
        return driven_windows(driver, scenes, steps, stride, 1 + samples)


@dataclass(frozen=True)
class Progress:
    """State of the fit ``name`` after ``update`` of at most ``updates``.

    ``losses`` are the last update's; ``score`` is the last evaluation's (lower is better), ``best``
    the lowest.
    """

    name: str
    update: int
    updates: int
    losses: dict[str, float]
    score: float | None
    best: float


OnProgress = Callable[[Progress], None]
