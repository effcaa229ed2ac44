"""Scores of forecasts of recorded windows: displacement errors, direction, long rollouts.

Kinds of forecasts by a generator: ``mean`` (z = 0), ``single`` (one sample), ``best_of_20`` (by ADE). ADE is the mean
error over the predicted steps, FDE the error at the last of them, both in m.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from sklearn.ensemble import HistGradientBoostingClassifier
from torch import Tensor

from ganlane.generator.windows import Windows

#: Samples of which the best counts.
SAMPLES = 20
#: Every ADE change is relative to this forecast: the last displacement repeated.
BASELINE = "constant_velocity"
#: Vehicles longer than this are trucks, m.
TRUCK_M = 6.0
#: A lateral move over the horizon has a direction if it is larger than this, m.
SIDEWAYS_M = 0.1
#: Keeps the gradient of a distance of 0 finite; 0.1 mm.
_SMALLEST_DISTANCE_M = 1e-4
#: ``{"all" or scene: {"ERROR/KIND": value}}``.
Metrics = dict[str, dict[str, float]]
#: Name of a forecast to positions [W, T, 2] in m relative to the present, or to errors [W, T] in m.
Forecasts = dict[str, np.ndarray]
Row = dict[str, Any]


def distance(one: Tensor, other: Tensor) -> Tensor:
    """Euclidean distance [...] between positions [..., 2], with a finite gradient at distance 0."""
    apart = one - other
    return torch.sqrt((apart * apart).sum(-1) + _SMALLEST_DISTANCE_M * _SMALLEST_DISTANCE_M)


def scene_metrics(windows: Windows, forecasts: Forecasts) -> Metrics:
    """``{"all" or scene: {"ade_m/KIND", "fde_m/KIND", ..., "windows"}}`` of the forecasts, in m."""
    errors, metrics = errors_of(forecasts, windows.future), {}
    for name, rows in {"all": np.ones(len(windows), dtype=bool), **windows.by_scene}.items():
        row = displacement_errors(errors, rows)
        metrics[name] = {f"{error}/{kind}": row[error][kind] for error in ("ade_m", "fde_m") for kind in forecasts}
        metrics[name]["windows"] = float(row["windows"])
    return metrics


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
    lateral, past = windows.future[:, -1, 1], windows.past
    moving = np.abs(lateral) > SIDEWAYS_M
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


def rmse_by_second(errors: Forecasts) -> dict[str, dict[str, float]]:
    """Root mean square error in m after each whole second (10 steps), of every forecast."""
    return {
        name: {
            f"{second} s": float(np.sqrt((values[:, 10 * second - 1] ** 2).mean()))
            for second in range(1, values.shape[1] // 10 + 1)
        }
        for name, values in errors.items()
    }


def open_loop_scores(windows: Windows, forecasts: Forecasts, fold: np.ndarray, least_part: int = 100) -> Row:
    """All scores of the forecasts of ``windows``, each of which was held out in its ``fold`` [W].

    Parts (lanes, classes) of fewer than ``least_part`` windows are left out.
    """
    errors = errors_of(forecasts, windows.future)

    def by(masks: dict[str, np.ndarray]) -> dict[str, Row]:
        return {name: displacement_errors(errors, rows) for name, rows in masks.items() if rows.any()}

    direction = direction_scores(forecasts, windows.future)
    direction["share_right"]["side classifier"] = side_classifier_share(windows, fold)
    return {
        **displacement_errors(errors),
        "folds": by({str(number): fold == number for number in range(int(fold.max()) + 1)}),
        "scenes": by(windows.by_scene),
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
