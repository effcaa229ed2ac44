"""Fitting the calibrated preset through joint rollouts of whole scenes.

Updates with z = 0, whose loss is the error, alternate with updates of two samples, whose loss is the energy score;
both are divided, step by step, by the error of constant velocity.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ganlane.generator.loop import descend
from ganlane.generator.networks import Generator
from ganlane.generator.rollout import (
    common_driver_params,
    evaluation_params,
    fit_anchor,
    rollout,
    sampled_driver_params,
)
from ganlane.generator.scores import BASELINE, Metrics, distance
from ganlane.generator.segments import SceneTracks, Segments, cut_segments, segment_batches, segment_starts
from ganlane.generator.windows import PREDICTED_STEPS
from ganlane.parameters.generator import CalibratedConfig

#: Segments in one forward pass of an evaluation; bounds the memory.
_SEGMENTS = 16


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of ``values`` where ``mask`` (broadcast) is true; 0 if it is nowhere."""
    kept = mask.expand_as(values).to(values.dtype)
    return (values * kept).sum() / kept.sum().clamp_min(1.0)


def energy_score(one: Tensor, other: Tensor, recorded: Tensor) -> Tensor:
    """Energy score of two samples, in the unit of the positions: mean error minus half their distance.

    All are positions [..., 2]. A proper score: least in expectation when the samples are drawn from the distribution
    of the recordings (Gneiting and Raftery 2007).
    """
    mean_error = 0.5 * (distance(one, recorded) + distance(other, recorded))
    return mean_error - 0.5 * distance(one, other)


@torch.no_grad()
def rollout_errors(generator: Generator, scenes: list[SceneTracks], config: CalibratedConfig) -> Metrics:
    """Errors of the calibrated preset's rollouts through scenes, for all and for each scene.

    Target lanes and driver parameters are those of the present, so no information of the future is used. Unlike
    forecasts of windows, these count a vehicle for as long as it is recorded.

    Returns:
        ``{"all" or scene: {"ade_m/KIND" over 0.8 s, "fde_m/KIND" at 0.8 s, "end_m/KIND" at the last step,
        "relative_mean", "relative_energy", "end_s", "windows"}}`` with the kinds ``mean``, ``single``,
        ``constant_velocity`` and ``energy`` (the energy score of two samples).
    """
    random, horizon = torch.Generator().manual_seed(0), config.held_out_horizon
    parts: dict[str, list[tuple[dict[str, Tensor], Tensor]]] = {"all": []}
    for scene in scenes:
        for batch in segment_batches(scene, horizon, config.held_out_stride, _SEGMENTS):
            segments = batch.without_intentions()
            headway, desired = evaluation_params(config)(segments)
            fresh = torch.randn(1 + horizon, 2, *headway.shape, generator.sizes.noise, generator=random)
            noise = torch.cat([torch.zeros_like(fresh[:, :1]), fresh], dim=1)
            mean, one, other = rollout(
                generator, segments, headway, desired, noise, config.noise_period_s, fit_anchor(config)
            )
            future = segments.future
            errors = {
                "mean": distance(mean, future),
                "single": distance(one, future),
                "energy": energy_score(one, other, future),
                BASELINE: distance(segments.constant_velocity, future),
            }
            for name in ("all", scene.name):
                parts.setdefault(name, []).append((errors, segments.scored))
    return {name: _step_means(errors, horizon) for name, errors in parts.items()}


def mean_by_step(parts: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Mean [H] of errors [B, H, V] where their mask [B, H, V] is true, over all parts."""
    count = torch.stack([scored.sum((0, 2)) for _, scored in parts]).sum(0).clamp_min(1)
    return torch.stack([(errors * scored).sum((0, 2)) for errors, scored in parts]).sum(0) / count


def _step_means(parts: list[tuple[dict[str, Tensor], Tensor]], horizon: int) -> dict[str, float]:
    """Means over the vehicles that are still recorded at the step in question."""
    means = {kind: mean_by_step([(errors[kind], scored) for errors, scored in parts]) for kind in parts[0][0]}
    short = min(PREDICTED_STEPS, horizon)
    metrics = {}
    for kind, errors in means.items():
        metrics[f"ade_m/{kind}"] = float(errors[:short].mean())
        metrics[f"fde_m/{kind}"] = float(errors[short - 1])
        metrics[f"end_m/{kind}"] = float(errors[-1])
    for kind in ("mean", "energy"):
        metrics[f"relative_{kind}"] = float((means[kind] / means[BASELINE].clamp_min(1e-6)).mean())
    windows = max(1.0, float(sum(scored[:, 0].sum() for _, scored in parts)))
    return metrics | {"end_s": 0.1 * horizon, "windows": windows}


class CalibratedTask:
    """The anchored generator on whole scenes; see :class:`ganlane.generator.loop.FitTask`."""

    def __init__(self, fitted: list[SceneTracks], validation: list[SceneTracks], config: CalibratedConfig):
        torch.manual_seed(config.seed)
        self.config = config
        self.generator = Generator(config.sizes)
        self.modules: dict[str, nn.Module] = {"generator": self.generator}
        self.optimisers: dict[str, torch.optim.Optimizer] = {
            "generator": torch.optim.Adam(self.generator.parameters())
        }
        self.random = torch.Generator().manual_seed(config.seed)
        self.validation = validation
        longest = max(config.horizons)
        cuts = [(scene, row) for scene in fitted for row in segment_starts(scene, longest)]
        #: All possible segments, sorted by their vehicles, so that neighbours need little padding.
        self.cuts = sorted(cuts, key=lambda cut: int(cut[0].present[cut[1]].sum()))
        segments = cut_segments(self.cuts[:: max(1, len(self.cuts) // 64)], longest)
        #: Mean error [H] in m of constant velocity on the fitted scenes.
        self.scale = mean_by_step([(distance(segments.constant_velocity, segments.future), segments.scored)])

    def update(self, number: int) -> dict[str, float]:
        """One rollout of a batch of segments and one step: alternately of the mean driver and of two samples."""
        config = self.config
        segments = self._batch()
        headway, desired = (
            sampled_driver_params(segments, self.random) if config.traits else common_driver_params(segments)
        )
        sampled = number % 2 == 1
        shape = (1 + segments.future.shape[1], 2 if sampled else 1, *headway.shape, config.sizes.noise)
        noise = torch.randn(shape, generator=self.random) if sampled else torch.zeros(shape)
        positions = rollout(
            self.generator, segments, headway, desired, noise, config.noise_period_s, fit_anchor(config)
        )
        if sampled:
            name, losses = "energy", energy_score(positions[0], positions[1], segments.future)
        else:
            name, losses = "mean", distance(positions[0], segments.future)
        loss = masked_mean(losses / self.scale[: losses.shape[1], None], segments.scored)
        descend(self.optimisers["generator"], loss, config.loop.largest_gradient)
        return {name: float(loss.detach())}

    def evaluate(self) -> float:
        """Mean of the error for z = 0 and the energy score on validation scenes, relative to constant velocity."""
        metrics = self.metrics(self.validation)["all"]
        return 0.5 * (metrics["relative_mean"] + metrics["relative_energy"])

    def metrics(self, scenes: list[SceneTracks]) -> Metrics:
        """Errors of the generator on ``scenes``, all and each."""
        return rollout_errors(self.generator, scenes, self.config)

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
