"""Hand-made trajectories for the tests of the view."""

import numpy as np
import polars as pl
from PIL.ImageColor import getrgb

from ganlane.view import EpisodeLabel, Trajectory


def straight(positions, lanes_of, frames=20, **changed):
    """Vehicles that start at ``positions`` (m) in ``lanes_of`` and drive at 20 m/s."""
    time = np.arange(frames) * 0.1
    full = np.ones((frames, len(positions)))
    constant = {"heading": 0.0, "speed": 20.0, "acceleration": 0.0, "length": 4.5, "width": 2.5}
    fields = {
        "label": EpisodeLabel("mobil", "idm", 1, 2, 3, 4.0),
        "time_s": time,
        "x": np.asarray(positions, float) + 20.0 * time[:, None],
        "y": full * np.asarray(lanes_of, float) * 4.0,
        **{name: value * full for name, value in constant.items()},
        "target_lane": (full * np.asarray(lanes_of)).astype(np.int64),
        "valid": full.astype(bool),
        "action": np.zeros(frames, np.int64),
        "returns": np.zeros(frames),
        "action_values": np.full((frames, 3), np.nan),
        "reward": np.full(frames, np.nan),
        "soft_crash_s": np.empty(0),
        "outcome": "",
    }
    return Trajectory(**{**fields, **changed})


def near(picture, colour, tolerance=6):
    """Which pixels have (nearly) this colour."""
    difference = picture.astype(int) - np.array(getrgb(colour))
    return np.abs(difference).max(axis=-1) <= tolerance


def area(picture, colour, tolerance=6):
    """Pixels of (nearly) this colour."""
    return near(picture, colour, tolerance).sum()


def place(picture, colour, tolerance=6):
    """Middle (column, row) of the pixels of this colour."""
    rows, columns = np.nonzero(near(picture, colour, tolerance))
    return (columns.min() + columns.max()) / 2, (rows.min() + rows.max()) / 2


def run_folder(folder, slope=1.0, evaluated=True):
    """The files that training leaves: some columns empty in the first rows."""
    folder.mkdir(parents=True)
    row = np.arange(30)
    learnt = [None if number < 3 else 0.1 * slope * number for number in row]
    metrics = {
        "decisions": (row + 1) * 10_000,
        "mean_return": slope * (row + 1.0),
        "crash_rate": (0.5 - 0.01 * row) * slope,
        "lane_changes_per_km": np.full(30, slope),
        "mean_q": learnt,
        "mean_discounted_return": np.full(30, 2.0 * slope),
        "loss": learnt,
    }
    pl.DataFrame(metrics).write_csv(folder / "metrics.csv")
    if evaluated:
        rows = {
            "decisions": [100_000, 200_000, 300_000],
            "mean_reward": [1.0, 3.0, 2.0],
            "crash_rate": [0.3, 0.2, 0.1],
        }
        pl.DataFrame(rows).write_csv(folder / "evaluation.csv")
    return folder


def panels(figure):
    """The panels of a figure by their titles."""
    return {axes.get_title("left"): axes for axes in figure.axes}


def legend_of(figure):
    """The names in a figure's legend."""
    return [text.get_text() for text in figure.legends[0].get_texts()]
