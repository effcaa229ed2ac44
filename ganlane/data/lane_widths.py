"""Lane widths of a recording, estimated from lateral positions and lane numbers."""

from __future__ import annotations

from typing import Final

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ganlane.errors import UserError

#: 12 feet, the standard lane of a US freeway: used where a recording has one lane only.
STANDARD_LANE_WIDTH_M: Final = 3.66
#: A lane counts for the first fit when it has this many rows (0.5 s of one vehicle or more).
_FEWEST_ROWS = 5
_PLAUSIBLE_M = (2.0, 6.0)


def scene_lane_widths(frame: pl.DataFrame) -> dict[str, float]:
    """Lane width in metres of every scene of a frame in the schema.

    Raises:
        UserError: a scene's lanes are less than 2 m or more than 6 m apart, or numbered from the left.
    """
    return {
        str(name): lane_width(rows["y"].to_numpy(), rows["lane"].to_numpy(), str(name))
        for (name,), rows in frame.group_by("scene", maintain_order=True)
    }


def scene_lane_counts(frame: pl.DataFrame) -> dict[str, int]:
    """Number of lanes of every scene of a frame in the schema: its highest lane number plus one."""
    counts = frame.group_by("scene", maintain_order=True).agg(pl.col("lane").max() + 1)
    return {str(scene): int(lanes) for scene, lanes in counts.iter_rows()}


def lane_width(y: NDArray[np.float64], lane: NDArray[np.int64], scene: str = "scene") -> float:
    """Lane width, m, at which the nearest lane of each row agrees best with its recorded lane number.

    The first estimate is the median slope between the median positions of each pair of lanes (Theil and Sen), which
    is robust to outliers. It is kept if no other width within 10 % of it puts more rows into their recorded lane;
    otherwise the result is the middle of the best range. Lane changes make that range narrow, since a vehicle's lane
    number changes just where it crosses the boundary.

    Args:
        y: [R] lateral positions, m, with 0 at the centre of lane 0 and growing with the lane number.
        lane: [R] lane numbers.
        scene: name for messages.

    Raises:
        UserError: the estimate is below 2 m or above 6 m.
    """
    guess = _median_spacing(y, lane)
    if guess is None:
        return STANDARD_LANE_WIDTH_M
    if not _PLAUSIBLE_M[0] <= guess <= _PLAUSIBLE_M[1]:
        raise UserError(
            f"{scene}: its lanes are {guess:.2f} m apart, expected {_PLAUSIBLE_M[0]:.0f} to {_PLAUSIBLE_M[1]:.0f} m; "
            "check that y is in metres, grows to the left, and that lanes are numbered in order."
        )
    low, high = _best_range(y, lane, guess)
    return guess if low <= guess <= high else 0.5 * (low + high)


def lane_grid(y: NDArray[np.float64], lane: NDArray[np.int64], scene: str = "scene") -> tuple[float, float]:
    """Lane width (:func:`lane_width`) and position of lane 0's centre, both m, where ``y`` has any origin.

    Each lane's median position gives an estimate of the centre; their median is returned.
    """
    numbers, centres = _centres(y, lane)
    spacing = _median_spacing(y, lane)
    if spacing is None:
        centre = float(np.median(y - lane * STANDARD_LANE_WIDTH_M))
    else:
        centre = float(np.median(centres - numbers * spacing))
    return lane_width(y - centre, lane, scene), centre


def _best_range(y: NDArray[np.float64], lane: NDArray[np.int64], guess: float) -> tuple[float, float]:
    """Widths within 10 % of the guess that most rows agree with; of several ranges, the nearest to the guess."""
    # A row of lane k agrees with the widths from y / (k + 1/2) to y / (k - 1/2); lane 0 has no upper end.
    begin = np.where(lane == 0, 2.0 * np.abs(y), y / (lane + 0.5))
    end = np.where(lane == 0, np.inf, y / np.where(lane == 0, 1.0, lane - 0.5))
    begin, end = np.clip(begin, 0.9 * guess, 1.1 * guess), np.clip(end, 0.9 * guess, 1.1 * guess)
    edges = np.unique(np.concatenate((begin, end, [0.9 * guess, 1.1 * guess])))
    inside = 0.5 * (edges[1:] + edges[:-1])
    agreeing = np.searchsorted(np.sort(begin), inside) - np.searchsorted(np.sort(end), inside)
    best = np.flatnonzero(agreeing == agreeing.max())
    nearest = best[np.argmin(np.abs(inside[best] - guess))]
    return float(edges[nearest]), float(edges[nearest + 1])


def _median_spacing(y: NDArray[np.float64], lane: NDArray[np.int64]) -> float | None:
    """Median slope between the lanes' median positions; None with fewer than two lanes."""
    numbers, centres = _centres(y, lane)
    if len(numbers) < 2:
        return None
    one, other = np.triu_indices(len(numbers), 1)
    return float(np.median((centres[other] - centres[one]) / (numbers[other] - numbers[one])))


def _centres(y: NDArray[np.float64], lane: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Lanes with enough rows, and their median positions."""
    numbers, rows = np.unique(lane, return_counts=True)
    numbers = numbers[rows >= _FEWEST_ROWS]
    return numbers, np.array([np.median(y[lane == number]) for number in numbers])
