"""Fitting the calibrated preset through joint rollouts of whole scenes.

Updates with z = 0, whose loss is the error, alternate with updates of two samples, whose loss is the energy score;
both are divided, step by step, by the error of constant velocity.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import nn

from ganlane.generator.closed_loop import ANCHOR, AnchorParameters
from ganlane.generator.loop import descend
from ganlane.generator.losses import distance, energy_score, masked_mean
from ganlane.generator.networks import Generator
from ganlane.generator.rollout import (
    DriverParams,
    common_driver_params,
    rollout,
    sampled_driver_params,
    sampled_rollouts,
    typical_driver_params,
)
from ganlane.generator.scores import Metrics, mean_by_step, rollout_errors
from ganlane.generator.segments import Segments, SegmentSource, cut_segments, segment_sources
from ganlane.generator.windows import SceneTracks
from ganlane.parameters.generator import CalibratedConfig


def fit_anchor(config: CalibratedConfig) -> AnchorParameters:
    """The anchor with a fit's washout and inputs."""
    return replace(ANCHOR, washout_s=config.washout_s, further_inputs=config.further_inputs)


def evaluation_params(config: CalibratedConfig) -> DriverParams:
    """Headways and desired speeds for evaluation."""
    return typical_driver_params if config.traits else common_driver_params


class CalibratedTask:
    """The anchored generator on whole scenes; see :class:`ganlane.generator.loop.FitTask`.

    Args:
        fitted: scenes to fit to.
        validation: scenes for early stopping.
        lane_widths: of every scene by its name, m.
        config: settings.
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
        self.sources = segment_sources(fitted, lane_widths)
        longest = max(config.horizons)
        self.cuts = self._cuts_by_size(longest)
        segments = cut_segments(self.cuts[:: max(1, len(self.cuts) // 64)], longest)
        #: Mean error [H] in m of constant velocity on the fitted scenes.
        self.scale = mean_by_step([(distance(segments.constant_velocity, segments.future), segments.scored)])

    def update(self, number: int) -> dict[str, float]:
        """One rollout of a batch of segments and one step: alternately of the mean driver and of two samples."""
        config = self.config
        segments = self._batch()
        drawn = sampled_driver_params(segments, self.random) if config.traits else common_driver_params(segments)
        headway, desired = drawn
        if number % 2:
            shape = (1 + segments.future.shape[1], 2, *headway.shape, config.sizes.noise)
            noise = torch.randn(shape, generator=self.random)
            one, other = sampled_rollouts(
                self.generator, segments, headway, desired, noise, config.noise_period_s, fit_anchor(config)
            )
            name, losses = "energy", energy_score(one, other, segments.future)
        else:
            zero = headway.new_zeros(*headway.shape, config.sizes.noise)
            positions = rollout(self.generator, segments, headway, desired, zero, parameters=fit_anchor(config))
            name, losses = "mean", distance(positions, segments.future)
        loss = masked_mean(losses / self.scale[: losses.shape[1], None], segments.scored)
        descend(self.optimisers["generator"], loss, self.generator, config.loop.largest_gradient)
        return {name: float(loss.detach())}

    def evaluate(self) -> float:
        """Mean of the error for z = 0 and the energy score on validation scenes, relative to constant velocity."""
        metrics = self.metrics(self.validation)["all"]
        return 0.5 * (metrics["relative_mean"] + metrics["relative_energy"])

    def metrics(self, scenes: list[SceneTracks]) -> Metrics:
        """Errors of the generator on ``scenes``, all and each."""
        config = self.config
        return rollout_errors(
            self.generator,
            segment_sources(scenes, self.lane_widths),
            config.held_out_horizon,
            config.held_out_stride,
            config.noise_period_s,
            parameters=fit_anchor(config),
            driver_params=evaluation_params(config),
        )

    def _cuts_by_size(self, horizon: int) -> list[tuple[SegmentSource, int]]:
        """All possible segments, sorted by their vehicles, so that neighbours need little padding."""
        cuts = [(source, row) for source in self.sources for row in source.starts(horizon)]
        return sorted(cuts, key=lambda cut: int(cut[0].scene.present[cut[1]].sum()))

    def _batch(self) -> Segments:
        """Segments with similar numbers of vehicles over a random horizon, mirrored in half of the updates."""
        shares = torch.tensor(self.config.shares, dtype=torch.float32)
        horizon = self.config.horizons[int(torch.multinomial(shares, 1, generator=self.random))]
        span = min(len(self.cuts), 8 * self.config.batch)
        begin = int(torch.randint(len(self.cuts) - span + 1, (), generator=self.random))
        rows = torch.randperm(span, generator=self.random)[: self.config.batch] + begin
        segments = cut_segments([self.cuts[row] for row in rows.tolist()], horizon)
        flip = self.config.mirror and float(torch.rand((), generator=self.random)) < 0.5
        return segments.mirrored() if flip else segments
