"""Hand-made trajectories for the tests of the view."""

from __future__ import annotations

import numpy as np

from ganlane.view import EpisodeLabel, Trajectory


def straight(positions, lanes_of, frames=20, lanes=3, speed=20.0, outcome="", **changed):
    """Vehicles that start at ``positions`` (m) in ``lanes_of`` and all drive at ``speed`` for ``frames`` frames."""
    time = np.arange(frames) * 0.1
    m = len(positions)
    full = np.ones((frames, m))
    fields = {
        "label": EpisodeLabel("mobil", "idm", 1, 2, lanes, 4.0),
        "time_s": time,
        "x": np.asarray(positions, float) + np.outer(time, np.full(m, speed)),
        "y": full * np.asarray(lanes_of, float) * 4.0,
        "heading": 0.0 * full,
        "speed": speed * full,
        "acceleration": 0.0 * full,
        "length": 4.5 * full,
        "width": 2.5 * full,
        "target_lane": (full * np.asarray(lanes_of)).astype(np.int64),
        "valid": full.astype(bool),
        "action": np.zeros(frames, np.int64),
        "returns": np.zeros(frames),
        "outcome": outcome,
    }
    return Trajectory(**{**fields, **changed})


def area(picture, colour, tolerance=6):
    """Pixels of (nearly) this colour."""
    return (np.abs(picture.astype(int) - np.array(colour)).max(axis=-1) <= tolerance).sum()


def place(picture, colour, tolerance=6):
    """Middle (column, row) of the pixels of this colour."""
    rows, columns = np.nonzero(np.abs(picture.astype(int) - np.array(colour)).max(axis=-1) <= tolerance)
    return (columns.min() + columns.max()) / 2, (rows.min() + rows.max()) / 2
