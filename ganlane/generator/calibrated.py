"""Fitting the calibrated preset through joint rollouts of whole scenes.

Updates with z = 0, scored by the error, take turns with updates of two samples, scored by the energy score; both
step by step relative to the error that constant velocity has there.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from ganlane.errors import UserError
from ganlane.generator.anchored import ANCHOR, EXTRA_INPUTS, AnchorParameters
from ganlane.generator.losses import distance, energy_score, masked_mean
from ganlane.generator.metrics import Metrics
from ganlane.generator.networks import Generator, GeneratorSizes
from ganlane.generator.rollout_metrics import closed_form_errors, rollout_metrics
from ganlane.generator.rollouts import rollout
from ganlane.generator.schedule import LoopConfig, descend
from ganlane.generator.stretches import RolloutScenes, SceneSource, cut_stretches, scene_sources
from ganlane.generator.tracks import SceneTracks
from ganlane.generator.traits import common_traits, fitting_traits, typical_traits


@dataclass(frozen=True)
class CalibratedConfig:
    """What the calibrated preset is fitted with.

    Attributes:
        sizes: of the generator.
        loop: how long.
        horizons: steps rolled out; every update draws one of them.
        shares: how often each is drawn, in proportion.
        held_out_horizon: steps rolled out in evaluation.
        batch: stretches of scenes per update.
        held_out_stride: frames between the starts of the stretches in evaluation.
        noise_period_s: how fast each driver's latent vector wanders.
        mirror: swap left and right in half of the updates.
        washout_s: time over which the residual's mean is taken away; infinite is without washout. The simulation
            takes the one of the weights.
        further_inputs: whether the network sees gap, closing speed, IDM's acceleration and lane offset.
        traits: whether every driver has a headway and a desired speed of its own.
        seed: of weights, batches, traits and noise.
    """

    sizes: GeneratorSizes = field(default_factory=lambda: GeneratorSizes(extra_inputs=EXTRA_INPUTS))
    loop: LoopConfig = field(default_factory=lambda: LoopConfig(updates=800, evaluate_every=80, warmup=40))
    horizons: tuple[int, ...] = (8, 16, 29)
    shares: tuple[float, ...] = (3.0, 1.0, 1.0)
    held_out_horizon: int = 29
    batch: int = 6
    held_out_stride: int = 3
    noise_period_s: float = 5.0
    mirror: bool = True
    washout_s: float = ANCHOR.washout_s
    further_inputs: bool = True
    traits: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        if len(self.shares) != len(self.horizons) or sum(self.shares) <= 0:
            raise UserError(
                f"shares={list(self.shares)}: give one share of the updates for each of the horizons "
                f"{list(self.horizons)}, not all 0."
            )

    @property
    def anchor(self) -> AnchorParameters:
        """The anchor as the fit drives with it."""
        return replace(ANCHOR, washout_s=self.washout_s, further_inputs=self.further_inputs)


class CalibratedTask:
    """The anchored generator on whole scenes; see :class:`ganlane.generator.loop.FitTask`.

    Args:
        fitted: scenes to fit to.
        validation: scenes that choose when to stop.
        lane_widths: of every scene by its name, m.
        config: how.
    """

    def __init__(
        self,
        fitted: list[SceneTracks],
        validation: list[SceneTracks],
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
        self.lane_widths, self.validation = lane_widths, validation
        self.sources = scene_sources(fitted, lane_widths)
        self.cuts = self._similar_cuts(max(config.horizons))
        self.scale = self._constant_velocity_errors(max(config.horizons))

    def update(self, number: int) -> dict[str, float]:
        """One rollout through a batch of stretches, and one step: of the mean driver and of two samples in turn."""
        scenes = self._batch(self._horizon())
        if number % 2:
            name, scores = "energy", energy_score(*self._two_samples(scenes), scenes.future)
        else:
            name, scores = "mean", distance(self._mean_driver(scenes), scenes.future)
        loss = masked_mean(scores / self.scale[: scores.shape[1], None], scenes.scored)
        descend(self.optimisers["generator"], loss, self.generator, self.config.loop.largest_gradient)
        return {name: float(loss.detach())}

    def evaluate(self) -> float:
        """Error for z = 0 and energy score on the validation scenes, both relative to constant velocity's error."""
        metrics = self.metrics(self.validation)["all"]
        return 0.5 * (metrics["relative_mean"] + metrics["relative_energy"])

    def metrics(self, scenes: list[SceneTracks]) -> Metrics:
        """Errors on ``scenes``, all and each."""
        config = self.config
        return rollout_metrics(
            self.generator,
            scene_sources(scenes, self.lane_widths),
            config.held_out_horizon,
            config.held_out_stride,
            config.noise_period_s,
            parameters=config.anchor,
            traits=typical_traits if config.traits else common_traits,
        )

    def _horizon(self) -> int:
        drawn = torch.multinomial(torch.tensor(self.config.shares, dtype=torch.float32), 1, generator=self.random)
        return self.config.horizons[int(drawn)]

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

    def _traits(self, scenes: RolloutScenes) -> tuple[Tensor, Tensor]:
        return fitting_traits(scenes, self.random) if self.config.traits else common_traits(scenes)

    def _mean_driver(self, scenes: RolloutScenes) -> Tensor:
        """One rollout [B, H, V, 2] with random traits and z = 0."""
        headway, desired = self._traits(scenes)
        quiet = headway.new_zeros(*headway.shape, self.config.sizes.noise)
        return rollout(self.generator, scenes, headway, desired, quiet, parameters=self.config.anchor)

    def _two_samples(self, scenes: RolloutScenes) -> tuple[Tensor, Tensor]:
        """Two rollouts [B, H, V, 2] with the same traits and different latent vectors, in one pass."""
        headway, desired = self._traits(scenes)
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
            self.config.anchor,
        )
        one, other = course.chunk(2)
        return one, other
