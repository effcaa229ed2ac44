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

    Args:
        logits: of any shape; above 0 the discriminator takes a trajectory for a recorded one.
        recorded: what all of them are: recorded (1) or generated (0).
    """
    labels = torch.full_like(logits, recorded)
    return binary_cross_entropy_with_logits(logits, labels, reduction="none").mean()


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of ``values`` where ``mask`` (broadcast) is true; 0 if it is nowhere."""
    # At least one, so that an empty mask gives 0 instead of NaN.
    weight = mask.expand_as(values).to(values.dtype)
    count = weight.sum().clamp_min(1.0)
    return (values * weight).sum() / count


class _Task(nn.Module):
    """A generator and its random numbers, to which a task adds other networks and the data.

    Every network has an optimiser of its own.

    Attributes:
        generator: the network that is fitted.
        optimisers: by the networks' names.
        random: draws batches and latent vectors.
        loop: how many updates there are, and when they end.
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
        """One update, the ``number``-th from 0 on; its losses by name."""
        raise NotImplementedError

    def evaluate(self) -> float:
        """The score on the validation scenes; lower is better."""
        raise NotImplementedError

    def fit(self, name: str, on_progress: OnProgress) -> int:
        """Update until the score improves no more, and take the best weights.

        Args:
            name: of the fit, for its reports.
            on_progress: called after every update.

        Returns:
            Updates until the best evaluation on the validation scenes.
        """
        loop = self.loop
        best = math.inf
        best_update = 0
        best_weights: dict[str, Tensor] = {}
        # Evaluations since the best one.
        waited = 0
        score = None

        for done in range(1, loop.updates + 1):
            # A linear warm-up, then a half cosine to 0.
            warmth = min(1.0, done / max(1, loop.warmup))
            rate = loop.learning_rate * warmth
            for optimiser in self.optimisers.values():
                optimiser.param_groups[0]["lr"] = rate * half_cosine(done - 1, loop.updates)
            losses = self.update(done - 1)

            if done % loop.evaluate_every == 0 or done == loop.updates:
                score = self.evaluate()
                waited += 1
                if score < best:
                    best = score
                    best_update = done
                    # A copy, since the next updates change the networks' own tensors.
                    best_weights = deepcopy(self.state_dict())
                    waited = 0

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
    """The Social-GAN on windows.

    Attributes:
        groups: k-means groups of the fitted scenes' windows.
        validation: windows and groups of the validation scenes.
    """

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
        groups = self.groups.select(rows)

        # Left and right are alike on a motorway, so mirrored groups are as good as recorded ones.
        flip = torch.rand(len(groups), generator=self.random) < 0.5
        groups = groups.mirrored(flip)

        # Vehicles of all groups, without padding: [n, T, 2], and [K + 1, n, T, 2].
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

        # Positions are the sums of displacements. ADE [K + 1, n] in m.
        apart = missed.cumsum(dim=-2)
        errors = distance(apart, torch.zeros_like(apart)).mean(-1)
        terms = {
            # Only the best of each vehicle's samples counts.
            "variety": errors[:-1].amin(dim=0).mean(),
            "single": errors[:-1].mean(),
            "mean": errors[-1].mean(),
        }
        if config.weights.adversarial > 0:
            # It wins where the discriminator takes its sample for a recorded one.
            fake = self.discriminator(generated[0])
            terms["adversarial"] = cross_entropy(fake, 1.0)

        # The terms' names are those of their weights.
        weighted = []
        for name, term in terms.items():
            weighted.append(getattr(config.weights, name) * term)
            losses[name] = float(term.detach())
        self.descend("generator", torch.stack(weighted).sum())
        return losses

    def evaluate(self) -> float:
        """ADE of the mean prediction on the validation scenes, m."""
        windows, groups = self.validation
        (mean,) = paper_forecasts(self.generator, windows, groups, self.config.seed, 0)
        errors = np.linalg.norm(mean - windows.future, axis=-1)
        return float(errors.mean())

    def forecasts(
        self,
        scenes: list[Recording],
        steps: int,
        stride: int,
        samples: int,
    ) -> np.ndarray:
        """Forecasts [1 + K, W, T, 2] of the windows of ``scenes``; the first is the mean one.

        Args:
            scenes: recordings.
            steps: not used: this preset predicts as many steps as it was fitted to.
            stride: frames between the starts of two windows.
            samples: K, the forecasts that are drawn.
        """
        windows, groups = self._grouped_windows(scenes, stride)
        return paper_forecasts(self.generator, windows, groups, self.config.seed, samples)

    def _grouped_windows(self, scenes: list[Recording], stride: int) -> tuple[Windows, Groups]:
        """All windows of ``scenes`` and their k-means groups."""
        config = self.config
        # n displacements need n + 1 positions.
        positions = config.sizes.observed + 1 + config.sizes.predicted
        windows = cut_windows(scenes, stride, positions)
        groups = group_windows(windows, config.group_size, config.seed)
        return windows, groups

    def _samples(self, groups: Groups) -> Tensor:
        """Recorded past and generated future [K + 1, n, T, 2] of n vehicles.

        The samples come first, the mean prediction last. Only the pooling needs the padded groups;
        the decoder runs without padding.
        """
        sizes = self.config.sizes
        mask = groups.mask
        past = groups.displacements[..., : sizes.observed, :]
        observation = self.generator.observe(past, groups.position, mask)
        context = self.generator.summarise(observation)

        # [B, G, ...] -> [n, ...]: from here on without padding.
        context = context[mask]
        vehicles = observation._replace(
            displacement=observation.displacement[mask],
            difference=observation.difference[mask],
        )

        shape = (self.config.samples + 1, len(context), sizes.noise)
        noise = torch.randn(shape, generator=self.random)
        # The mean driver.
        noise[-1] = 0.0

        outputs = self.generator.decode(context, noise, vehicles, sizes.predicted)
        future = displacements_of(outputs, vehicles.displacement)
        # All samples have the same past.
        past = past[mask].expand(len(future), -1, -1, -1)
        return torch.cat([past, future], dim=-2)


class CalibratedTask(_Task):
    """The anchored generator on whole scenes.

    Attributes:
        validation: scenes on which it is evaluated.
        cuts: all possible segments of the fitted scenes, as a scene and the row where one starts.
        scale: mean error [H] in m of constant velocity on the fitted scenes.
    """

    def __init__(
        self, fitted: list[Recording], validation: list[Recording], config: CalibratedConfig
    ):
        super().__init__(config)
        self.config = config
        self.validation = validation

        # Every segment has room for the longest horizon; a shorter one uses its beginning.
        longest = max(config.horizons)
        cuts = []
        for scene in fitted:
            for row in segment_starts(scene, longest):
                cuts.append((scene, row))

        def vehicles_at_start(cut: tuple[Recording, int]) -> int:
            scene, row = cut
            return int(scene.present[row].sum())

        # Sorted by their vehicles, so that neighbours need little padding.
        self.cuts = sorted(cuts, key=vehicles_at_start)

        # Some 64 of them, evenly spread, measure constant velocity well enough.
        stride = max(1, len(self.cuts) // 64)
        segments = cut_segments(self.cuts[::stride], longest)
        errors = distance(segments.constant_velocity, segments.future)
        self.scale = mean_by_step([(errors, segments.scored)])

    def update(self, number: int) -> dict[str, float]:
        """One rollout of a batch of segments and one step.

        Even updates fit the mean driver (z = 0), odd ones two samples.
        """
        segments = self._batch()
        drivers = driver_params(segments, self.random)

        # The energy score needs two samples, the mean error one. Losses are [B, H, V] in m.
        if number % 2 == 1:
            name = "energy"
            shape = noise_shape(self.generator, segments, 2)
            noise = torch.randn(shape, generator=self.random)
            one, other = rollout(self.generator, segments, drivers, noise, self.config)
            losses = energy_score(one, other, segments.future)
        else:
            name = "mean"
            noise = torch.zeros(noise_shape(self.generator, segments, 1))
            (mean,) = rollout(self.generator, segments, drivers, noise, self.config)
            losses = distance(mean, segments.future)

        # Late steps err most, so each is measured by what constant velocity errs there.
        relative = losses / self.scale[: losses.shape[1], None]
        loss = masked_mean(relative, segments.scored)
        return {name: self.descend("generator", loss)}

    def evaluate(self) -> float:
        """The score of rollouts through the validation scenes."""
        return rollout_score(self.generator, self.validation, self.config)

    def forecasts(
        self,
        scenes: list[Recording],
        steps: int,
        stride: int,
        samples: int,
    ) -> np.ndarray:
        """Forecasts [1 + K, W, T, 2] of the windows of ``scenes``; the first is the mean one.

        Args:
            scenes: recordings.
            steps: T, of 0.1 s.
            stride: frames between the starts of two windows.
            samples: K, the forecasts that are drawn.
        """
        driver = calibrated_driver(self.generator, self.config, samples)
        return driven_windows(driver, scenes, steps, stride, 1 + samples)

    def _batch(self) -> Segments:
        """Segments with similar numbers of vehicles over a random horizon.

        They are mirrored in half of the updates.
        """
        config = self.config
        shares = torch.tensor(config.shares, dtype=torch.float32)
        drawn = torch.multinomial(shares, 1, generator=self.random)
        horizon = config.horizons[int(drawn)]

        # Random ones among neighbours in the order of their size: from a place on, eight times as
        # many as are wanted.
        span = min(len(self.cuts), 8 * config.batch)
        places = len(self.cuts) - span + 1
        begin = int(torch.randint(places, (), generator=self.random))
        rows = begin + torch.randperm(span, generator=self.random)[: config.batch]
        cuts = [self.cuts[row] for row in rows.tolist()]
        segments = cut_segments(cuts, horizon)

        # Left and right are alike.
        if float(torch.rand((), generator=self.random)) < 0.5:
            return segments.mirrored()
        return segments


class HumanTask(nn.Module):
    """A policy, fitted for a fixed schedule: no scene stops it early.

    Attributes:
        scenes: recordings of several lanes.
        following: recordings of cars that follow each other in one lane.
        generator: policy, estimator and observer; before the fit, with weights of no use.
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
        """Fit the policy, and then the observer; the steps of the policy's fit.

        Args:
            name: of the fit, for its reports.
            on_progress: called after every step, with a score if it is one of the fine-tuning.
        """
        steps = fit_steps(self.config)
        done = 0
        best = math.inf

        def report(cost: float | None) -> None:
            nonlocal done, best
            done += 1
            if cost is not None:
                best = min(best, cost)
            on_progress(Progress(name, done, steps, {}, cost, best))

        # In forecasts no width is known.
        scenes = []
        for scene in self.scenes:
            scenes.append(replace(scene, width=np.full_like(scene.width, WIDTH_M)))

        self.generator = fit_human(self.config, scenes, self.following, report)
        fit_observer(self.generator, self.scenes, self.config)
        return steps

    def forecasts(
        self,
        scenes: list[Recording],
        steps: int,
        stride: int,
        samples: int,
    ) -> np.ndarray:
        """Forecasts [1 + K, W, T, 2] of the windows of ``scenes``; the first is the mean one.

        Args:
            scenes: recordings.
            steps: T, of 0.1 s.
            stride: frames between the starts of two windows.
            samples: K, the forecasts that are drawn.
        """
        driver = human_driver(self.generator, samples)
        return driven_windows(driver, scenes, steps, stride, 1 + samples)


@dataclass(frozen=True)
class Progress:
    """State of a fit after an update.

    Attributes:
        name: of the fit.
        update: its updates so far.
        updates: how many there are at most.
        losses: of the last update, by name.
        score: of the last evaluation, lower is better; None before the first one.
        best: the lowest score so far; infinite before the first one.
    """

    name: str
    update: int
    updates: int
    losses: dict[str, float]
    score: float | None
    best: float


OnProgress = Callable[[Progress], None]
