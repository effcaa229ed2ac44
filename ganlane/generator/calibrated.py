"""Fitting the calibrated preset through joint rollouts of whole scenes.

Updates with z = 0, scored by the error, take turns with updates of two samples, scored by the energy score; both
step by step relative to the error that constant velocity has there.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from ganlane.generator.anchored import EXTRA_INPUTS
from ganlane.generator.loop import LoopConfig, descend
from ganlane.generator.losses import distance, energy_score, masked_mean
from ganlane.generator.metrics import Metrics
from ganlane.generator.networks import Generator, GeneratorSizes
from ganlane.generator.rollout_metrics import closed_form_errors, rollout_metrics
from ganlane.generator.rollouts import rollout
from ganlane.generator.stretches import RolloutScenes, SceneSource, cut_stretches
from ganlane.generator.tracks import SceneTracks
from ganlane.generator.traits import fitting_traits


@dataclass(frozen=True)
class CalibratedConfig:
    """What the calibrated preset is fitted with.

    Attributes:
        sizes: of the generator.
        loop: how long.
        horizons: steps rolled out, in equal shares of the updates one after the other.
        held_out_horizon: steps rolled out in evaluation.
        batch: stretches of scenes per update.
        held_out_stride: frames between the starts of the held-out stretches.
        noise_period_s: how fast each driver's latent vector wanders.
        mirror: swap left and right in half of the updates.
        seed: of weights, batches, traits and noise.
    """

    sizes: GeneratorSizes = field(default_factory=lambda: GeneratorSizes(extra_inputs=EXTRA_INPUTS))
    loop: LoopConfig = field(default_factory=lambda: LoopConfig(updates=400, evaluate_every=40, warmup=20))
    horizons: tuple[int, ...] = (8, 16, 29)
    held_out_horizon: int = 29
    batch: int = 6
    held_out_stride: int = 6
    noise_period_s: float = 5.0
    mirror: bool = True
    seed: int = 0


class CalibratedTask:
    """The anchored generator on whole scenes; see :class:`ganlane.generator.loop.FitTask`.

    Args:
        fitted, held_out: recorded scenes.
        lane_widths: of every scene by its name, m.
        config: how.
    """

    def __init__(
        self,
        fitted: list[SceneTracks],
        held_out: list[SceneTracks],
        lane_widths: dict[str, float],
        config: CalibratedConfig,
    ):
        torch.manual_seed(config.seed)
        self.config = config
        self.generator = Generator(config.sizes)
        self.modules: dict[str, nn.Module] = {"generator": self.generator}
        self.optimisers: dict[str, torch.optim.Optimizer] = {
            "generator": torch.optim.Adam(self.generator.parameters())
        }
        self.random = torch.Generator().manual_seed(config.seed)
        self.sources = [SceneSource.of(scene, lane_widths[scene.name]) for scene in fitted]
        self.held_out = [SceneSource.of(scene, lane_widths[scene.name]) for scene in held_out]
        self.cuts = self._similar_cuts(max(config.horizons))
        self.scale = self._constant_velocity_errors(max(config.horizons))

    def update(self, number: int) -> dict[str, float]:
        """One rollout through a batch of stretches, and one step: of the mean driver and of two samples in turn."""
        scenes = self._batch(self._horizon(number))
        if number % 2:
            name, scores = "energy", energy_score(*self._two_samples(scenes), scenes.future)
        else:
            name, scores = "mean", distance(self._mean_driver(scenes), scenes.future)
        loss = masked_mean(scores / self.scale[: scores.shape[1], None], scenes.scored)
        descend(self.optimisers["generator"], loss, self.generator, self.config.loop.largest_gradient)
        return {name: float(loss.detach())}

    def evaluate(self) -> float:
        """Error for z = 0 and energy score on the held-out scenes, both relative to constant velocity's error."""
        metrics = self.metrics()["all"]
        return 0.5 * (metrics["relative_mean"] + metrics["relative_energy"])

    def metrics(self) -> Metrics:
        """Errors on the held-out scenes, all and each."""
        config = self.config
        return rollout_metrics(
            self.generator, self.held_out, config.held_out_horizon, config.held_out_stride, config.noise_period_s
        )

    def _horizon(self, number: int) -> int:
        share = len(self.config.horizons) * number // self.config.loop.updates
        return self.config.horizons[share]

    def _similar_cuts(self, horizon: int) -> list[tuple[SceneSource, int]]:
        """All stretches that can be cut, in order of the vehicles in them: neighbours pad each other little."""
        cuts = [(source, row) for source in self.sources for row in source.starts(horizon)]
        return sorted(cuts, key=lambda cut: int(cut[0].scene.present[cut[1]].sum()))

    def _constant_velocity_errors(self, horizon: int) -> Tensor:
        """Mean error [H] in m of constant velocity on the fitted scenes."""
        scenes = cut_stretches(self.cuts[:: max(1, len(self.cuts) // 64)], horizon)
        errors, scored = closed_form_errors(scenes), scenes.scored.float()
        return (errors * scored).sum((0, 2)) / scored.sum((0, 2)).clamp_min(1.0)

    def _batch(self, horizon: int) -> RolloutScenes:
        """Stretches with about as many vehicles each, mirrored in half of the updates."""
        span = min(len(self.cuts), 8 * self.config.batch)
        begin = int(torch.randint(len(self.cuts) - span + 1, (), generator=self.random))
        rows = torch.randperm(span, generator=self.random)[: self.config.batch] + begin
        scenes = cut_stretches([self.cuts[row] for row in rows.tolist()], horizon)
        flip = self.config.mirror and float(torch.rand((), generator=self.random)) < 0.5
        return scenes.mirrored() if flip else scenes

    def _mean_driver(self, scenes: RolloutScenes) -> Tensor:
        """One rollout [B, H, V, 2] with random traits and z = 0."""
        headway, desired = fitting_traits(scenes, self.random)
        quiet = headway.new_zeros(*headway.shape, self.config.sizes.noise)
        return rollout(self.generator, scenes, headway, desired, quiet)

    def _two_samples(self, scenes: RolloutScenes) -> tuple[Tensor, Tensor]:
        """Two rollouts [B, H, V, 2] with the same traits and different latent vectors, in one pass."""
        headway, desired = fitting_traits(scenes, self.random)
        shape = (2 * len(headway), headway.shape[1], self.config.sizes.noise)
        fresh = torch.randn(scenes.future.shape[1] + 1, *shape, generator=self.random)
        course = rollout(
            self.generator,
            scenes.repeated(2),
            headway.repeat(2, 1),
            desired.repeat(2, 1),
            fresh[0],
            fresh[1:],
            self.config.noise_period_s,
        )
        one, other = course.chunk(2)
        return one, other
