"""Errors of joint rollouts through held-out scenes, beside constant velocity."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ganlane.generator.anchored import ANCHOR, AnchorParameters
from ganlane.generator.losses import distance, energy_score
from ganlane.generator.metrics import Metrics
from ganlane.generator.networks import Generator
from ganlane.generator.rollouts import rollout
from ganlane.generator.stretches import RolloutScenes, SceneSource, cut_stretches
from ganlane.generator.traits import typical_traits
from ganlane.generator.windows import PREDICTED_STEPS, PRESENT

#: Headways and desired speeds [B, V] that the vehicles of a stretch drive with.
Traits = Callable[[RolloutScenes], tuple[Tensor, Tensor]]
#: Stretches rolled out in one pass; bounds the memory.
_CHUNK = 16


def closed_form_errors(scenes: RolloutScenes) -> Tensor:
    """Errors [B, H, V] in m of repeating the last observed displacement."""
    now, before = scenes.positions[:, PRESENT], scenes.positions[:, PRESENT - 1]
    steps = torch.arange(1, scenes.future.shape[1] + 1, dtype=now.dtype)
    predicted = now[:, None] + (now - before)[:, None] * steps[:, None, None]
    return distance(predicted, scenes.future)


@torch.no_grad()
def stretch_errors(
    generator: Generator,
    scenes: RolloutScenes,
    noise_period_s: float,
    random: torch.Generator,
    parameters: AnchorParameters = ANCHOR,
    traits: Traits = typical_traits,
) -> dict[str, Tensor]:
    """Errors [B, H, V] in m: z = 0 (``mean``), one sample (``single``), ``constant_velocity``, and ``energy``.

    Target lanes are the present ones and the traits look at the present alone, so nothing of the future leaks in.
    """
    scenes = scenes.without_intentions()
    headway, desired = traits(scenes)
    fresh = torch.randn(
        scenes.future.shape[1] + 1, 2 * len(headway), headway.shape[1], generator.sizes.noise, generator=random
    )
    quiet = torch.zeros_like(fresh[:, : len(headway)])
    noise = torch.cat([quiet, fresh], dim=1)
    course = rollout(
        generator,
        scenes.repeated(3),
        headway.repeat(3, 1),
        desired.repeat(3, 1),
        noise[0],
        noise[1:],
        noise_period_s,
        parameters,
    )
    mean, one, other = course.chunk(3)
    return {
        "mean": distance(mean, scenes.future),
        "single": distance(one, scenes.future),
        "energy": energy_score(one, other, scenes.future),
        "constant_velocity": closed_form_errors(scenes),
    }


def rollout_metrics(
    generator: Generator,
    sources: list[SceneSource],
    horizon: int,
    stride: int,
    noise_period_s: float,
    seed: int = 0,
    parameters: AnchorParameters = ANCHOR,
    traits: Traits = typical_traits,
) -> Metrics:
    """Errors on stretches of held-out scenes, for all and for each scene.

    Returns:
        ``{"all" or scene: {"ade_m/KIND" over 0.8 s, "fde_m/KIND" at 0.8 s, "end_m/KIND" at the last step,
        "relative_mean", "relative_energy", "end_s", "windows"}}`` with the kinds of :func:`stretch_errors`.
    """
    random = torch.Generator().manual_seed(seed)
    collected: dict[str, list[tuple[dict[str, Tensor], Tensor]]] = {"all": []}
    for source in sources:
        cuts = [(source, row) for row in source.starts(horizon, stride)]
        for chunk in (cuts[at : at + _CHUNK] for at in range(0, len(cuts), _CHUNK)):
            scenes = cut_stretches(chunk, horizon)
            errors = stretch_errors(generator, scenes, noise_period_s, random, parameters, traits)
            part = (errors, scenes.scored)
            collected["all"].append(part)
            collected.setdefault(source.scene.name, []).append(part)
    return {name: _summary(parts, horizon) for name, parts in collected.items()}


def _summary(parts: list[tuple[dict[str, Tensor], Tensor]], horizon: int) -> dict[str, float]:
    """Means over vehicles whose recording lasts until the step in question."""
    count = torch.stack([scored.sum((0, 2)) for _, scored in parts]).sum(0).clamp_min(1)
    by_step = {
        kind: torch.stack([(errors[kind] * scored).sum((0, 2)) for errors, scored in parts]).sum(0) / count
        for kind in parts[0][0]
    }
    short = min(PREDICTED_STEPS, horizon)
    summary = {}
    for kind, errors in by_step.items():
        summary[f"ade_m/{kind}"] = float(errors[:short].mean())
        summary[f"fde_m/{kind}"] = float(errors[short - 1])
        summary[f"end_m/{kind}"] = float(errors[-1])
    for kind in ("mean", "energy"):
        summary[f"relative_{kind}"] = float((by_step[kind] / by_step["constant_velocity"].clamp_min(1e-6)).mean())
    return summary | {"end_s": 0.1 * horizon, "windows": float(count[0])}
