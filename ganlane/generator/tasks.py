"""What is fitted: the losses, updates and scores of both presets, and the loop that runs them.

**paper**, open loop: adversarial, variety, single-sample and mean terms on k-means groups of
windows. Losses after Gupta et al. (2018), with the changes that the fit needs here.

**calibrated**: joint rollouts of whole scenes. Updates with z = 0, whose loss is the error,
alternate with updates of two samples, whose loss is the energy score; both are divided, step by
step, by the error of constant velocity.
"""

from __future__ import annotations

import io
import math
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from ganlane.errors import UserError
from ganlane.files import has_checksum, refuse_without_checksum, sealed_archive, write_bytes
from ganlane.generator.checkpoint import Metrics
from ganlane.generator.closed_loop import driver_params, rollout
from ganlane.generator.forecasts import (
    BASELINE,
    distance,
    energy_score,
    mean_by_step,
    paper_forecasts,
    repeated,
    rollout_errors,
    scene_metrics,
)
from ganlane.generator.networks import (
    DIFFERENCE_SCALE_M,
    Discriminator,
    Generator,
    displacements_of,
)
from ganlane.generator.windows import (
    Groups,
    SceneTracks,
    Segments,
    Windows,
    cut_segments,
    cut_windows,
    group_windows,
    segment_starts,
)
from ganlane.settings.generator import CalibratedConfig, LoopConfig, PaperConfig

Config = PaperConfig | CalibratedConfig


def distances(predicted: Tensor, recorded: Tensor) -> Tensor:
    """Distances [..., T] in m between two trajectories given as displacements [..., T, 2]."""
    apart = (predicted - recorded).cumsum(dim=-2)
    return distance(apart, torch.zeros_like(apart))


def variety_loss(errors: Tensor) -> Tensor:
    """Mean error of each vehicle's best sample; ``errors`` is [K, n] in m."""
    return errors.amin(dim=0).mean()


def cross_entropy(logits: Tensor, recorded: float) -> Tensor:
    """Cross-entropy of classifying trajectories as recorded (1) or generated (0) by their logits.

    Ln 2 is chance.
    """
    return binary_cross_entropy_with_logits(
        logits, torch.full_like(logits, recorded), reduction="none"
    ).mean()


def discriminator_accuracy(recorded: Tensor, generated: Tensor) -> Tensor:
    """Share of logits with the right sign, both classes with equal weight; 0.5 is chance."""
    return 0.5 * (
        (recorded > 0).to(recorded.dtype).mean() + (generated <= 0).to(generated.dtype).mean()
    )


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of ``values`` where ``mask`` (broadcast) is true; 0 if it is nowhere."""
    kept = mask.expand_as(values).to(values.dtype)
    return (values * kept).sum() / kept.sum().clamp_min(1.0)


class _Networks:
    """A generator with its optimiser and random numbers, to which a task adds other networks."""

    def __init__(self, config: Config):
        torch.manual_seed(config.seed)
        self.generator = Generator(config.sizes)
        self.modules: dict[str, nn.Module] = {}
        self.optimisers: dict[str, torch.optim.Optimizer] = {}
        self.add("generator", self.generator)
        self.random = torch.Generator().manual_seed(config.seed)
        self.largest_gradient = config.loop.largest_gradient

    def add(self, name: str, module: nn.Module) -> None:
        """One more network to fit, with an optimiser of its own."""
        self.modules[name], self.optimisers[name] = module, torch.optim.Adam(module.parameters())

    def descend(self, name: str, loss: Tensor) -> float:
        """One step of a network down its ``loss``, whose value is returned, with the gradient's
        norm clipped.
        """
        self.optimisers[name].zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.modules[name].parameters(), self.largest_gradient)
        self.optimisers[name].step()
        return float(loss.detach())


class PaperTask(_Networks):
    """The Social-GAN on windows."""

    def __init__(
        self, fitted: list[SceneTracks], validation: list[SceneTracks], config: PaperConfig
    ):
        super().__init__(config)
        self.config = config
        self.discriminator = Discriminator(config.sizes.embedding, config.sizes.hidden)
        self.add("discriminator", self.discriminator)
        _, self.groups = self._grouped_windows(fitted, config.stride)
        self.validation = self._grouped_windows(validation, config.held_out_stride)

    def update(self, number: int) -> dict[str, float]:
        """One step of the discriminator, if the adversarial term is on, and one of the generator."""
        config = self.config
        groups = self.groups.select(
            torch.randint(len(self.groups), (config.batch,), generator=self.random)
        )
        if config.mirror:
            groups = groups.mirrored(torch.rand(len(groups), generator=self.random) < 0.5)
        recorded = groups.displacements[groups.mask]
        generated = self._samples(groups, config.history_noise)
        losses = {}
        if config.weights.adversarial > 0:
            real, fake = self.discriminator(recorded), self.discriminator(generated[0].detach())
            loss = 0.5 * (cross_entropy(real, 1.0) + cross_entropy(fake, 0.0))
            losses["discriminator"] = self.descend("discriminator", loss)
        observed = config.sizes.observed
        errors = distances(generated[..., observed:, :], recorded[..., observed:, :]).mean(-1)
        terms = {
            "variety": variety_loss(errors[:-1]),
            "single": errors[:-1].mean(),
            "mean": errors[-1].mean(),
        }
        if config.weights.adversarial > 0:
            terms["adversarial"] = cross_entropy(self.discriminator(generated[0]), 1.0)
        weighted = [getattr(config.weights, name) * term for name, term in terms.items()]
        self.descend("generator", torch.stack(weighted).sum())
        return losses | {name: float(term.detach()) for name, term in terms.items()}

    def evaluate(self) -> float:
        """ADE of the mean prediction on the validation scenes, m."""
        windows, groups = self.validation
        mean = paper_forecasts(self.generator, windows, groups, samples=0)["mean"]
        return float(np.linalg.norm(mean - windows.future, axis=-1).mean())

    @torch.no_grad()
    def metrics(self, scenes: list[SceneTracks]) -> Metrics:
        """ADE and FDE of the generator on ``scenes``, all and each, and the discriminator's
        accuracy on them.
        """
        windows, groups = self._grouped_windows(scenes, self.config.held_out_stride)
        forecasts = paper_forecasts(self.generator, windows, groups, self.config.seed)
        forecasts[BASELINE] = repeated(windows.past[:, -1], self.config.sizes.predicted)
        logits = (
            self.discriminator(groups.displacements[groups.mask]),
            self.discriminator(self._samples(groups)[0]),
        )
        accuracy = {"held_out_accuracy": float(discriminator_accuracy(*logits))}
        return scene_metrics(windows, forecasts) | {"discriminator": accuracy}

    def _grouped_windows(self, scenes: list[SceneTracks], stride: int) -> tuple[Windows, Groups]:
        """All windows of ``scenes`` and their k-means groups."""
        sizes = self.config.sizes
        windows = cut_windows(scenes, stride, sizes.observed + 1 + sizes.predicted)
        return windows, group_windows(windows, self.config.group_size, self.config.seed)

    def _samples(self, groups: Groups, history_noise: float = 0.0) -> Tensor:
        """Recorded past and generated future [K + 1, n, T, 2] of n vehicles: the samples, the mean
        prediction last.

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
        noise = torch.randn(
            self.config.samples + 1, len(context), sizes.noise, generator=self.random
        )
        noise[-1] = 0.0
        outputs = self.generator.decode(context, noise, vehicles, sizes.predicted)
        future = displacements_of(outputs, vehicles.displacement)
        return torch.cat([past[mask].expand(len(future), -1, -1, -1), future], dim=-2)


class CalibratedTask(_Networks):
    """The anchored generator on whole scenes."""

    def __init__(
        self, fitted: list[SceneTracks], validation: list[SceneTracks], config: CalibratedConfig
    ):
        super().__init__(config)
        self.config, self.validation = config, validation
        longest = max(config.horizons)
        cuts = [(scene, row) for scene in fitted for row in segment_starts(scene, longest)]
        #: All possible segments, sorted by their vehicles, so that neighbours need little padding.
        self.cuts = sorted(cuts, key=lambda cut: int(cut[0].present[cut[1]].sum()))
        segments = cut_segments(self.cuts[:: max(1, len(self.cuts) // 64)], longest)
        #: Mean error [H] in m of constant velocity on the fitted scenes.
        self.scale = mean_by_step(
            [(distance(segments.constant_velocity, segments.future), segments.scored)]
        )

    def update(self, number: int) -> dict[str, float]:
        """One rollout of a batch of segments and one step.

        Alternately of the mean driver and of two samples.
        """
        config = self.config
        segments = self._batch()
        drivers = driver_params(segments, config.traits, self.random)
        sampled = number % 2 == 1
        shape = (
            1 + segments.future.shape[1],
            2 if sampled else 1,
            *segments.length.shape,
            config.sizes.noise,
        )
        noise = torch.randn(shape, generator=self.random) if sampled else torch.zeros(shape)
        positions = rollout(self.generator, segments, drivers, noise, config)
        if sampled:
            name, losses = "energy", energy_score(positions[0], positions[1], segments.future)
        else:
            name, losses = "mean", distance(positions[0], segments.future)
        loss = masked_mean(losses / self.scale[: losses.shape[1], None], segments.scored)
        return {name: self.descend("generator", loss)}

    def evaluate(self) -> float:
        """Mean of the error for z = 0 and the energy score on validation scenes, relative to
        constant velocity.
        """
        metrics = self.metrics(self.validation)["all"]
        return 0.5 * (metrics["relative_mean"] + metrics["relative_energy"])

    def metrics(self, scenes: list[SceneTracks]) -> Metrics:
        """Errors of the generator on ``scenes``, all and each."""
        return rollout_errors(self.generator, scenes, self.config)

    def _batch(self) -> Segments:
        """Segments with similar numbers of vehicles over a random horizon, mirrored in half of the
        updates.
        """
        shares = torch.tensor(self.config.shares, dtype=torch.float32)
        horizon = self.config.horizons[int(torch.multinomial(shares, 1, generator=self.random))]
        span = min(len(self.cuts), 8 * self.config.batch)
        begin = int(torch.randint(len(self.cuts) - span + 1, (), generator=self.random))
        rows = torch.randperm(span, generator=self.random)[: self.config.batch] + begin
        segments = cut_segments([self.cuts[row] for row in rows.tolist()], horizon)
        flip = self.config.mirror and float(torch.rand((), generator=self.random)) < 0.5
        return segments.mirrored() if flip else segments


Task = PaperTask | CalibratedTask


@dataclass(frozen=True)
class Progress:
    """State of a fit after ``update`` of at most ``updates``, ``seconds`` after the start of this
    run.

    ``losses`` are the last update's; ``score`` is the last evaluation's (lower is better), ``best``
    the lowest.
    """

    update: int
    updates: int
    losses: dict[str, float]
    score: float | None
    best: float
    seconds: float


OnProgress = Callable[[Progress], None]


class FitLoop:
    """Runs a task until it stops improving: updates, evaluations on validation scenes, early
    stopping.

    ``path`` keeps the state after every evaluation; the fit resumes from it if it exists.
    ``seconds`` is the time of the updates, those in earlier runs of the same fit too.
    """

    def __init__(self, task: Task, path: str | Path | None = None):
        self.task, self.config = task, task.config.loop
        self.path = None if path is None else Path(path)
        self.done, self.waited, self.best_update, self.best = 0, 0, 0, math.inf
        self.seconds = 0.0
        self.best_weights: dict[str, dict[str, Tensor]] = {}
        if self.path is not None and self.path.exists():
            self._resume(self.path)

    def run(self, on_progress: OnProgress | None = None) -> None:
        """Fit, then put the best weights into the task's networks."""
        begun, earlier, score = time.monotonic(), self.seconds, None
        while self.done < self.config.updates and self.waited < self.config.patience:
            for optimiser in self.task.optimisers.values():
                optimiser.param_groups[0]["lr"] = learning_rate(self.config, self.done)
            losses = self.task.update(self.done)
            self.done += 1
            seconds = time.monotonic() - begun
            self.seconds = earlier + seconds
            late = self.config.max_seconds is not None and seconds > self.config.max_seconds
            if (
                self.done % self.config.evaluate_every == 0
                or self.done == self.config.updates
                or late
            ):
                score = self._evaluate()
            if on_progress is not None:
                on_progress(
                    Progress(self.done, self.config.updates, losses, score, self.best, seconds)
                )
            if late:
                break
        for name, weights in self.best_weights.items():
            self.task.modules[name].load_state_dict(weights)

    def _evaluate(self) -> float:
        score = self.task.evaluate()
        self.waited += 1
        if score < self.best:
            self.best, self.best_update, self.waited = score, self.done, 0
            self.best_weights = {
                name: deepcopy(module.state_dict()) for name, module in self.task.modules.items()
            }
        if self.path is not None:
            # Tensors and plain data only.
            state = {
                "counters": [self.done, self.waited, self.best_update],
                "best": self.best,
                "seconds": self.seconds,
                "best_weights": self.best_weights,
                "modules": {
                    name: module.state_dict() for name, module in self.task.modules.items()
                },
                "optimisers": {
                    name: optimiser.state_dict() for name, optimiser in self.task.optimisers.items()
                },
                "random": self.task.random.get_state(),
            }
            file = io.BytesIO()
            torch.save(state, file)
            write_bytes(self.path, sealed_archive(file.getvalue()))
        return score

    def _resume(self, path: Path) -> None:
        """Continue from a stored state; reading it never executes code."""
        content = path.read_bytes()
        whole = has_checksum(content, path)
        try:
            state = torch.load(io.BytesIO(content), weights_only=True)
            if "counters" not in state:
                raise ValueError("no counters")
        except Exception as error:
            raise UserError(
                f"{path}: not the state of a fit; give the file that a fit keeps, or remove it."
            ) from error
        try:
            for name, module in self.task.modules.items():
                module.load_state_dict(state["modules"][name])
            for name, optimiser in self.task.optimisers.items():
                optimiser.load_state_dict(state["optimisers"][name])
        except (KeyError, RuntimeError, ValueError) as error:
            raise UserError(
                f"{path}: holds another fit than the one asked for; give the same preset and sizes or remove it."
            ) from error
        self.done, self.waited, self.best_update = state["counters"]
        self.best, self.best_weights, self.seconds = (
            state["best"],
            state["best_weights"],
            state["seconds"],
        )
        self.task.random.set_state(state["random"])
        if not whole:
            refuse_without_checksum(path)


def learning_rate(config: LoopConfig, number: int) -> float:
    """Linear warm-up, then a half cosine to 0."""
    rise = min(1.0, (number + 1) / max(1, config.warmup))
    return config.learning_rate * rise * 0.5 * (1.0 + math.cos(math.pi * number / config.updates))
