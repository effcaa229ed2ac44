"""Scores of predictions: errors of the networks during a fit, and of any forecasts of recorded windows.

Kinds of predictions: ``mean`` (z = 0), ``single`` (one sample), ``best_of_20`` (by ADE), ``constant_velocity``.
ADE is the mean error over the predicted steps, FDE the error at the last of them, both in m.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from sklearn.ensemble import HistGradientBoostingClassifier
from torch import Tensor

from ganlane.generator.closed_loop import ANCHOR, AnchorParameters
from ganlane.generator.groups import Groups
from ganlane.generator.losses import distance, distances, energy_score
from ganlane.generator.networks import Generator
from ganlane.generator.rollout import DriverParams, sampled_rollouts, typical_driver_params
from ganlane.generator.segments import SegmentSource
from ganlane.generator.windows import PREDICTED_STEPS, Windows

#: Samples of which the best counts.
SAMPLES = 20
#: Groups, and segments, in one forward pass; bounds the memory.
_GROUPS, _SEGMENTS = 128, 16
#: Every ADE change is relative to this forecast: the last displacement repeated.
BASELINE = "constant_velocity"
#: Vehicles longer than this are trucks, m.
TRUCK_M = 6.0
#: A lateral move over the horizon has a direction if it is larger than this, m.
SIDEWAYS_M = 0.1
#: ``{"all" or scene: {"ERROR/KIND": value}}``.
Metrics = dict[str, dict[str, float]]
#: Name of a forecast to positions [W, T, 2] in m relative to the present, or to errors [W, T] in m.
Forecasts = dict[str, np.ndarray]
Row = dict[str, Any]


@torch.no_grad()
def window_errors(generator: Generator, groups: Groups, seed: int = 0) -> Metrics:
    """ADE and FDE of the paper's preset in m, over all ``groups`` and for each of their scenes.

    Returns:
        ``{"all" or scene: {"ade_m/KIND", "fde_m/KIND", ..., "windows"}}`` with the four kinds of this module.
    """
    random = torch.Generator().manual_seed(seed)
    parts: dict[str, list[Tensor]] = {}
    scenes = []
    for rows in torch.arange(len(groups)).split(_GROUPS):
        chunk = groups.select(rows)
        scenes.append(chunk.scene[:, None].expand_as(chunk.mask)[chunk.mask])
        for kind, values in _group_errors(generator, chunk, random).items():
            parts.setdefault(kind, []).append(values[chunk.mask])
    errors, scene = {kind: torch.cat(pieces) for kind, pieces in parts.items()}, torch.cat(scenes)
    metrics = {"all": _window_means(errors, torch.ones_like(scene, dtype=torch.bool))}
    for index in scene.unique().tolist():
        metrics[groups.scene_names[index]] = _window_means(errors, scene == index)
    return metrics


def _group_errors(generator: Generator, groups: Groups, random: torch.Generator) -> dict[str, Tensor]:
    """Errors [B, G, T] in m by kind."""
    observed = generator.sizes.observed
    past, future = groups.displacements[..., :observed, :], groups.displacements[..., observed:, :]
    noise = torch.randn(SAMPLES, *groups.mask.shape, generator.sizes.noise, generator=random)
    observation = generator.observe(past, groups.position, groups.mask)
    errors = distances(generator(observation, torch.cat([torch.zeros_like(noise[:1]), noise])), future)
    best = errors[1:].mean(-1).argmin(dim=0)[None, ..., None].expand(1, *errors.shape[1:])
    return {
        "mean": errors[0],
        "single": errors[1],
        f"best_of_{SAMPLES}": errors[1:].gather(0, best)[0],
        BASELINE: distances(past[..., -1:, :].expand_as(future), future),
    }


def _window_means(errors: dict[str, Tensor], rows: Tensor) -> dict[str, float]:
    """ADE and FDE over the chosen windows, and their number."""
    means = {}
    for kind, values in errors.items():
        means[f"ade_m/{kind}"] = float(values[rows].mean())
        means[f"fde_m/{kind}"] = float(values[rows][:, -1].mean())
    return means | {"windows": float(rows.sum())}


@torch.no_grad()
def rollout_errors(
    generator: Generator,
    sources: list[SegmentSource],
    horizon: int,
    stride: int,
    noise_period_s: float,
    seed: int = 0,
    parameters: AnchorParameters = ANCHOR,
    driver_params: DriverParams = typical_driver_params,
) -> Metrics:
    """Errors of the calibrated preset's rollouts through scenes, for all and for each scene.

    Target lanes and driver parameters are those of the present, so no information of the future is used.

    Returns:
        ``{"all" or scene: {"ade_m/KIND" over 0.8 s, "fde_m/KIND" at 0.8 s, "end_m/KIND" at the last step,
        "relative_mean", "relative_energy", "end_s", "windows"}}`` with the kinds ``mean``, ``single``,
        ``constant_velocity`` and ``energy`` (the energy score of two samples).
    """
    random = torch.Generator().manual_seed(seed)
    parts: dict[str, list[tuple[dict[str, Tensor], Tensor]]] = {"all": []}
    for source in sources:
        for batch in source.batches(horizon, stride, _SEGMENTS):
            segments = batch.without_intentions()
            headway, desired = driver_params(segments)
            fresh = torch.randn(1 + horizon, 2, *headway.shape, generator.sizes.noise, generator=random)
            noise = torch.cat([torch.zeros_like(fresh[:, :1]), fresh], dim=1)
            mean, one, other = sampled_rollouts(
                generator, segments, headway, desired, noise, noise_period_s, parameters
            )
            future = segments.future
            errors = {
                "mean": distance(mean, future),
                "single": distance(one, future),
                "energy": energy_score(one, other, future),
                BASELINE: distance(segments.constant_velocity, future),
            }
            for name in ("all", source.scene.name):
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


def errors_of(forecasts: Forecasts, recorded: np.ndarray) -> Forecasts:
    """Distances [W, T] in m of every forecast [W, T, 2] to the recording."""
    return {name: np.linalg.norm(positions - recorded, axis=-1) for name, positions in forecasts.items()}


def displacement_errors(errors: Forecasts, rows: np.ndarray | None = None) -> Row:
    """ADE and FDE in m of every forecast over the chosen windows, and the ADE's change to the baseline's in %."""
    chosen = errors if rows is None else {name: values[rows] for name, values in errors.items()}
    ade = {name: float(values.mean()) for name, values in chosen.items()}
    fde = {name: float(values[:, -1].mean()) for name, values in chosen.items()}
    change = {name: 100.0 * (value / ade[BASELINE] - 1.0) for name, value in ade.items()}
    return {"windows": len(chosen[BASELINE]), "ade_m": ade, "fde_m": fde, "ade_change_percent": change}


def parts_of(windows: Windows, least: int) -> dict[str, np.ndarray]:
    """Masks [W] of the windows by lane (1 the leftmost) and by class, of parts with at least ``least`` windows."""
    truck = windows.length > TRUCK_M
    parts = {f"lane {lane}": windows.lane_from_left == lane for lane in np.unique(windows.lane_from_left)}
    parts |= {"car": ~truck, "truck": truck}
    return {name: rows for name, rows in parts.items() if rows.sum() >= least}


def direction_scores(forecasts: Forecasts, recorded: np.ndarray, observed: np.ndarray | None = None) -> Row:
    """Among vehicles that move more than 0.1 m sideways: share predicted to the right side.

    Args:
        forecasts: positions [W, T, 2] relative to the present.
        recorded: the recorded ones.
        observed: lateral moves [W] in m while observed, to be added to both; if None, only the move after the
            present counts.
    """
    before = 0.0 if observed is None else observed
    lateral = before + recorded[:, -1, 1]
    moving = np.abs(lateral) > SIDEWAYS_M
    right = {name: ((before + course[:, -1, 1]) * lateral > 0)[moving] for name, course in forecasts.items()}
    shares = {name: float(hits.mean()) if len(hits) else None for name, hits in right.items()}
    return {"windows": int(moving.sum()), "share_right": shares}


def side_classifier_share(windows: Windows, fold: np.ndarray) -> float | None:
    """Share of lateral moves after the present whose side a dedicated classifier predicts; None without moves.

    Gradient boosting on the observed motion, the lane and the length, fitted to the other folds' moving vehicles: a
    reference for :func:`direction_scores`, about as much as the history contains.
    """
    lateral = windows.future[:, -1, 1]
    moving = np.abs(lateral) > SIDEWAYS_M
    past = windows.past
    moved = past[..., 1][:, ::-1].cumsum(axis=1)
    others = np.stack([windows.lane, windows.lane_from_left, windows.length], axis=1)
    differences = np.diff(past, axis=1)[..., 0]
    features = np.concatenate([past.reshape(len(past), -1), differences, moved, others], axis=1)
    features, left, fold = features[moving], lateral[moving] > 0, fold[moving]
    hits = []
    for number in np.unique(fold):
        own = fold == number
        if len(np.unique(left[~own])) == 2:
            model = HistGradientBoostingClassifier(max_iter=150, max_leaf_nodes=15, random_state=0)
            hits.append(model.fit(features[~own], left[~own]).predict(features[own]) == left[own])
    return float(np.concatenate(hits).mean()) if hits else None


def rmse_by_second(errors: Forecasts, step_s: float = 0.1) -> dict[str, dict[str, float]]:
    """Root mean square error in m after each whole second, of every forecast."""
    per_second = round(1.0 / step_s)
    return {
        name: {
            f"{second} s": float(np.sqrt((values[:, second * per_second - 1] ** 2).mean()))
            for second in range(1, values.shape[1] // per_second + 1)
        }
        for name, values in errors.items()
    }


def open_loop_scores(windows: Windows, forecasts: Forecasts, fold: np.ndarray, least_part: int = 100) -> Row:
    """All scores of forecasts over 0.8 s, pooled over the windows of all folds.

    Args:
        windows: of the held-out scenes.
        forecasts: of these windows.
        fold: [W], the fold in which each window was held out.
        least_part: parts (lanes, classes) with fewer windows are left out.
    """
    errors = errors_of(forecasts, windows.future)

    def by(masks: dict[str, np.ndarray]) -> dict[str, Row]:
        return {name: displacement_errors(errors, rows) for name, rows in masks.items() if rows.any()}

    direction = direction_scores(forecasts, windows.future)
    direction["share_right"]["side classifier"] = side_classifier_share(windows, fold)
    return {
        **displacement_errors(errors),
        "folds": by({str(number): fold == number for number in range(int(fold.max()) + 1)}),
        "scenes": by(
            {name: windows.scene == windows.scene_names.index(name) for name in sorted(windows.scene_names)}
        ),
        "parts": by(parts_of(windows, least_part)),
        "direction": direction,
        "direction_whole_window": direction_scores(forecasts, windows.future, windows.past[..., 1].sum(1)),
    }


def long_rollout_scores(windows: Windows, forecasts: Forecasts) -> Row:
    """RMSE after each second, number of windows and tracks, and the ratio to constant velocity's at the end."""
    rmse = rmse_by_second(errors_of(forecasts, windows.future))
    last = f"{windows.future.shape[1] // 10} s"
    ratio = {name: values[last] / rmse[BASELINE][last] for name, values in rmse.items()}
    tracks = len(np.unique(np.stack([windows.scene, windows.vehicle]), axis=1).T)
    return {"windows": len(windows), "tracks": tracks, "rmse_m": rmse, "ratio_to_constant_velocity": ratio}
