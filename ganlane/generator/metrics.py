"""Open-loop errors on recordings: ADE and FDE of the mean prediction, of one sample, and of the best of 20."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from ganlane.generator.groups import Groups
from ganlane.generator.losses import distances
from ganlane.generator.networks import Generator

SAMPLES = 20
#: Groups in one forward pass; bounds the memory.
_CHUNK = 128
Metrics = dict[str, dict[str, float]]


def constant_velocity(displacements: Tensor, observed: int) -> Tensor:
    """Errors [B, G, T] in m of repeating the last observed of the ``displacements`` [B, G, observed + T, 2]."""
    future = displacements[..., observed:, :]
    return distances(displacements[..., observed - 1 : observed, :].expand_as(future), future)


@torch.no_grad()
def group_errors(generator: Generator, groups: Groups, random: torch.Generator) -> dict[str, Tensor]:
    """Errors [B, G, T] in m: ``mean`` (z = 0), ``single``, ``best_of_20`` (by ADE), ``constant_velocity``."""
    observed, latent = generator.sizes.observed, generator.sizes.noise
    past, future = groups.displacements[..., :observed, :], groups.displacements[..., observed:, :]
    seen = generator.observe(past, groups.position, groups.mask)
    noise = torch.randn(SAMPLES, *groups.mask.shape, latent, generator=random)
    errors = distances(generator(seen, torch.cat([torch.zeros_like(noise[:1]), noise])), future)
    best = errors[1:].mean(-1).argmin(dim=0)[None, ..., None].expand(1, *errors.shape[1:])
    return {
        "mean": errors[0],
        "single": errors[1],
        f"best_of_{SAMPLES}": errors[1:].gather(0, best)[0],
        "constant_velocity": constant_velocity(groups.displacements, observed),
    }


def _chunks(groups: Groups) -> Iterator[Groups]:
    for rows in torch.arange(len(groups)).split(_CHUNK):
        yield groups.select(rows)


def open_loop(generator: Generator, groups: Groups, scene_names: tuple[str, ...], seed: int = 0) -> Metrics:
    """ADE and FDE in m over the predicted steps, for all of ``groups`` and for each of its scenes.

    Returns:
        ``{"all" or scene: {"ade_m/KIND", "fde_m/KIND", ..., "windows"}}`` with the kinds of :func:`group_errors`.
    """
    random = torch.Generator().manual_seed(seed)
    parts: dict[str, list[Tensor]] = {}
    scenes = []
    for chunk in _chunks(groups):
        scenes.append(chunk.scene[:, None].expand_as(chunk.mask)[chunk.mask])
        for kind, errors in group_errors(generator, chunk, random).items():
            parts.setdefault(kind, []).append(errors[chunk.mask])
    flat, scene = {kind: torch.cat(pieces) for kind, pieces in parts.items()}, torch.cat(scenes)
    metrics = {"all": _summary(flat, torch.ones_like(scene, dtype=torch.bool))}
    for index in scene.unique().tolist():
        metrics[scene_names[index]] = _summary(flat, scene == index)
    return metrics


def _summary(errors: dict[str, Tensor], rows: Tensor) -> dict[str, float]:
    """ADE and FDE of the chosen windows, and how many they are."""
    summary = {}
    for kind, values in errors.items():
        summary[f"ade_m/{kind}"] = float(values[rows].mean())
        summary[f"fde_m/{kind}"] = float(values[rows][:, -1].mean())
    return summary | {"windows": float(rows.sum())}
