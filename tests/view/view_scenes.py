"""Hand-made trajectories for the tests of the view."""

from __future__ import annotations

import numpy as np
import polars as pl

from ganlane.view import EpisodeLabel, Trajectory


def straight(positions, lanes_of, frames=20, lanes=3, speed=20.0, outcome="", **changed):
    """Vehicles that start at ``positions`` (m) in ``lanes_of`` and all drive at ``speed`` for
    ``frames`` frames.
    """
    time = np.arange(frames) * 0.1
    full = np.ones((frames, len(positions)))
    constant = {"heading": 0.0, "speed": speed, "acceleration": 0.0, "length": 4.5, "width": 2.5}
    fields = {
        "label": EpisodeLabel("mobil", "idm", 1, 2, lanes, 4.0),
        "time_s": time,
        "x": np.asarray(positions, float) + speed * time[:, None],
        "y": full * np.asarray(lanes_of, float) * 4.0,
        **{name: value * full for name, value in constant.items()},
        "target_lane": (full * np.asarray(lanes_of)).astype(np.int64),
        "valid": full.astype(bool),
        "action": np.zeros(frames, np.int64),
        "returns": np.zeros(frames),
    }
    return Trajectory(**{**fields, "outcome": outcome, **changed})


def area(picture, colour, tolerance=6):
    """Pixels of (nearly) this colour."""
    return (np.abs(picture.astype(int) - np.array(colour)).max(axis=-1) <= tolerance).sum()


def place(picture, colour, tolerance=6):
    """Middle (column, row) of the pixels of this colour."""
    rows, columns = np.nonzero(
        np.abs(picture.astype(int) - np.array(colour)).max(axis=-1) <= tolerance
    )
    return (columns.min() + columns.max()) / 2, (rows.min() + rows.max()) / 2


def run_folder(folder, slope=1.0, evaluated=True):
    """The files that training leaves: some columns empty in the first rows."""
    folder.mkdir(parents=True)
    x = np.arange(1, 31) * 10_000
    learnt = [None if k < 3 else 0.1 * slope * k for k in range(30)]
    columns = {"mean_return": slope * x / 1e4, "crash_rate": (0.5 - 0.01 * np.arange(30)) * slope}
    more = {
        "lane_changes_per_km": slope + 0.0 * x,
        "mean_q": learnt,
        "mean_discounted_return": 2.0 * slope + 0.0 * x,
    }
    pl.DataFrame({"decisions": x, **columns, **more, "loss": learnt}).write_csv(
        folder / "metrics.csv"
    )
    if evaluated:
        rows = {
            "decisions": x[9::10],
            "mean_reward": [1.0, 3.0, 2.0],
            "crash_rate": [0.3, 0.2, 0.1],
        }
        pl.DataFrame(rows).write_csv(folder / "evaluation.csv")
    return folder
