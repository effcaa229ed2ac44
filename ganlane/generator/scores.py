"""Scores of forecasts: errors over all windows and over parts of them, and whether they move to the right side."""

from __future__ import annotations

from typing import Any

import numpy as np
from sklearn.ensemble import HistGradientBoostingClassifier

from ganlane.generator.forecasts import Forecasts
from ganlane.generator.windows import Windows

#: What every reduction is relative to: repeating the last displacement.
BASELINE = "constant_velocity"
#: A vehicle that is longer than this is a truck, m.
TRUCK_M = 6.0
#: A lateral move over the horizon that is larger than this has a direction, m.
SIDEWAYS_M = 0.1
Row = dict[str, Any]


def errors_of(forecasts: Forecasts, recorded: np.ndarray) -> Forecasts:
    """Distances [W, T] in m of every forecast [W, T, 2] to what was recorded."""
    return {name: np.linalg.norm(course - recorded, axis=-1) for name, course in forecasts.items()}


def displacement_errors(errors: Forecasts, rows: np.ndarray | None = None) -> Row:
    """ADE and FDE in m of every forecast over the chosen windows, and the ADE's change to the baseline's in %."""
    chosen = errors if rows is None else {name: values[rows] for name, values in errors.items()}
    ade = {name: float(values.mean()) for name, values in chosen.items()}
    fde = {name: float(values[:, -1].mean()) for name, values in chosen.items()}
    change = {name: 100.0 * (value / ade[BASELINE] - 1.0) for name, value in ade.items()}
    return {"windows": len(chosen[BASELINE]), "ade_m": ade, "fde_m": fde, "ade_change_percent": change}


def parts_of(windows: Windows, least: int) -> dict[str, np.ndarray]:
    """Rows of the windows by lane (1 the leftmost) and by class, of the parts with at least ``least`` windows."""
    truck = windows.length > TRUCK_M
    parts = {f"lane {lane}": windows.lane_from_left == lane for lane in np.unique(windows.lane_from_left)}
    parts |= {"car": ~truck, "truck": truck}
    return {name: rows for name, rows in parts.items() if rows.sum() >= least}


def direction_scores(forecasts: Forecasts, recorded: np.ndarray, observed: np.ndarray | None = None) -> Row:
    """Among vehicles that move more than 0.1 m sideways: share predicted to the right side.

    Args:
        forecasts: positions [W, T, 2] relative to the present.
        recorded: the same, as recorded.
        observed: lateral moves [W] in m while the vehicles were observed, if they count too; without them the move
            is the one after the present alone.
    """
    before = 0.0 if observed is None else observed
    aside = before + recorded[:, -1, 1]
    moving = np.abs(aside) > SIDEWAYS_M
    right = {name: ((before + course[:, -1, 1]) * aside > 0)[moving] for name, course in forecasts.items()}
    shares = {name: float(hits.mean()) if len(hits) else None for name, hits in right.items()}
    return {"windows": int(moving.sum()), "share_right": shares}


def side_classifier_share(windows: Windows, fold: np.ndarray) -> float | None:
    """Share of lateral moves after the present whose side a classifier tells that was fitted for nothing else.

    Gradient boosting on the observed motion, the lane and the length, fitted to the other folds' moving vehicles:
    about what the history holds, to judge :func:`direction_scores` by. None if nobody moves.
    """
    aside = windows.future[:, -1, 1]
    moving = np.abs(aside) > SIDEWAYS_M
    seen, left, fold = _seen(windows)[moving], aside[moving] > 0, fold[moving]
    hits = []
    for number in np.unique(fold):
        own = fold == number
        if len(np.unique(left[~own])) == 2:
            model = HistGradientBoostingClassifier(max_iter=150, max_leaf_nodes=15, random_state=0)
            hits.append(model.fit(seen[~own], left[~own]).predict(seen[own]) == left[own])
    return float(np.concatenate(hits).mean()) if hits else None


def _seen(windows: Windows) -> np.ndarray:
    """What the classifier looks at, [W, F]."""
    past = windows.past
    moved = past[..., 1][:, ::-1].cumsum(axis=1)
    others = np.stack([windows.lane, windows.lane_from_left, windows.length], axis=1)
    return np.concatenate([past.reshape(len(past), -1), np.diff(past, axis=1)[..., 0], moved, others], axis=1)


def rmse_by_second(errors: Forecasts, step_s: float = 0.1) -> dict[str, dict[str, float]]:
    """Root of the mean squared distance in m after each whole second, of every forecast."""
    per_second = round(1.0 / step_s)
    return {
        name: {
            f"{second} s": float(np.sqrt((values[:, second * per_second - 1] ** 2).mean()))
            for second in range(1, values.shape[1] // per_second + 1)
        }
        for name, values in errors.items()
    }


def by_name(errors: Forecasts, index: np.ndarray, names: tuple[str, ...]) -> dict[str, Row]:
    """:func:`displacement_errors` of every scene (or fold) that has windows."""
    rows = {name: index == number for number, name in enumerate(names)}
    return {name: displacement_errors(errors, chosen) for name, chosen in rows.items() if chosen.any()}


def open_loop_scores(windows: Windows, forecasts: Forecasts, fold: np.ndarray, least_part: int = 100) -> Row:
    """Everything that is reported of forecasts over 0.8 s, pooled over the windows of all folds.

    Args:
        windows: of the reported scenes.
        forecasts: of these windows.
        fold: [W], the fold in which each window was reported.
        least_part: parts (lanes, classes) with fewer windows are left out.
    """
    errors = errors_of(forecasts, windows.future)
    folds = tuple(str(number) for number in range(int(fold.max()) + 1))
    parts = {name: displacement_errors(errors, rows) for name, rows in parts_of(windows, least_part).items()}
    direction = direction_scores(forecasts, windows.future)
    direction["share_right"]["side classifier"] = side_classifier_share(windows, fold)
    return {
        **displacement_errors(errors),
        "folds": by_name(errors, fold, folds),
        "scenes": dict(sorted(by_name(errors, windows.scene, windows.scene_names).items())),
        "parts": parts,
        "direction": direction,
        "direction_whole_window": direction_scores(forecasts, windows.future, windows.past[..., 1].sum(1)),
    }
