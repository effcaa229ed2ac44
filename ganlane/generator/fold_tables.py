"""What ``ganlane train_generator folds=K`` shows: errors pooled over the folds, beside baselines and publications."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

_PUBLISHED_VELOCITY_M = (0.73, 1.78, 3.13, 4.78, 6.68)
#: RMSE in m after 1 to 5 s on NGSIM, as published: on other test sets than ours, so for orientation only.
PUBLISHED_RMSE_M = {
    "constant velocity (published)": _PUBLISHED_VELOCITY_M,
    "CS-LSTM (published)": (0.61, 1.27, 2.09, 3.10, 4.37),
    "Social-GAN (published)": (0.57, 1.32, 2.22, 3.26, 4.40),
}
_WIDTH = 32


def fold_tables(folds: Mapping[str, Any]) -> str:
    """All tables of :func:`ganlane.generator.cross_validate`'s result, as text."""
    scores = folds["open_loop"]
    tables = [_pooled(scores), _rows("by fold", scores["folds"]), _rows("by scene", scores["scenes"])]
    tables += [_rows("by lane (1 leftmost) and class", scores["parts"]), _direction(scores)]
    if "rollout" in folds:
        tables.append(_rollout(folds["rollout"]))
    return "\n\n".join(tables)


def _line(name: str, cells: Iterable[str]) -> str:
    return f"{name:<{_WIDTH}}" + "".join(f"{cell:>15}" for cell in cells)


def _pooled(scores: Mapping[str, Any]) -> str:
    """ADE and FDE of everybody over the windows of all folds."""
    lines = [_line(f"{scores['windows']} windows of all folds", ("ADE, m", "FDE, m", "ADE to CV"))]
    for kind, ade in scores["ade_m"].items():
        change = f"{scores['ade_change_percent'][kind]:+.1f} %"
        lines.append(_line(kind, (f"{ade:.3f}", f"{scores['fde_m'][kind]:.3f}", change)))
    return "\n".join(lines)


def _rows(title: str, rows: Mapping[str, Any]) -> str:
    """Windows, constant velocity's ADE, and the generator's change of it, for every row."""
    first = next(iter(rows.values()))
    kinds = [kind for kind in first["ade_m"] if kind in ("mean", "single") or kind.startswith("best_of")]
    lines = [_line(title, ("windows", "CV, m", *kinds))]
    for name, row in rows.items():
        changes = [f"{row['ade_change_percent'][kind]:+.1f} %" for kind in kinds]
        lines.append(_line(name, (str(row["windows"]), f"{row['ade_m']['constant_velocity']:.3f}", *changes)))
    return "\n".join(lines)


def _direction(scores: Mapping[str, Any]) -> str:
    """Share of lateral moves of more than 0.1 m that are foretold to the right side."""
    later, whole = scores["direction"], scores["direction_whole_window"]
    lines = [_line("lateral move to the right side", ("after present", "whole window"))]
    lines.append(_line("windows that move", (str(later["windows"]), str(whole["windows"]))))
    for kind, share in later["share_right"].items():
        shares = (share, whole["share_right"].get(kind))
        lines.append(_line(kind, ("" if value is None else f"{100 * value:.1f} %" for value in shares)))
    return "\n".join(lines)


def _rollout(rollout: Mapping[str, Any]) -> str:
    """RMSE after 1 to 5 s, with what others published."""
    seconds = list(next(iter(rollout["rmse_m"].values())))
    lines = [_line(f"RMSE, m ({rollout['windows']} windows)", (*seconds, "to CV"))]
    for kind, values in rollout["rmse_m"].items():
        ratio = f"{rollout['ratio_to_constant_velocity'][kind]:.2f}"
        lines.append(_line(kind, (*(f"{value:.2f}" for value in values.values()), ratio)))
    for kind, published in PUBLISHED_RMSE_M.items():
        lines.append(
            _line(
                kind, (*(f"{value:.2f}" for value in published), f"{published[-1] / _PUBLISHED_VELOCITY_M[-1]:.2f}")
            )
        )
    return "\n".join(lines)
