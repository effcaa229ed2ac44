"""Lane widths of recordings, and lane changes with their durations (equation 11).

Recordings and simulations are measured in the same form, :class:`Tracks`: flat arrays, vectorised
over all samples.

**What counts.** The nearest lane changes between two samples, and it is the old one during the 0.5
s before and the new one during the 0.5 s after, without interruption. A vehicle that only touches
the boundary has not changed lanes.

**Duration** (equation 11, after Thiemann et al. 2008, in our reading). Going back from the
crossing, the change starts at the first sample at which the vehicle is within 0.3 m of the old
lane's centre or moves towards the new lane at less than 0.1 m/s; ``tau_s`` is the time in between.
``tau_e`` is the time from the crossing to the first sample within 0.3 m of the new lane's centre or
slower than 0.1 m/s. The lateral speed is the mean over 1 s, centred, since recorded positions are
noisy; the offset alone is not enough, since a fitted road is accurate to a few decimetres and
drivers keep an offset. Where the track ends first, the change is censored on that side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ganlane.data.schema import FRAME_S
from ganlane.errors import UserError

#: 12 feet, the standard lane of a US freeway: used where a recording has one lane only.
STANDARD_LANE_WIDTH_M = 3.66
Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

# In samples, 0.1 s each.
#: Least in the old lane before a change and in the new one after it.
_HOLD = 5
#: Half the window of the mean lateral speed.
_HALF_WINDOW = 5
#: Longest search for start and end, before and after the crossing.
_REACH = 200
#: Offset from the lane's centre and lateral speed below which the change has not begun or is over,
#: m and m/s.
_CENTRED_M = 0.3
_STILL_MPS = 0.1


def scene_lane_widths(frame: pl.DataFrame) -> dict[str, float]:
    """Lane width in metres of every scene of a frame in the schema.

    Errors are :func:`lane_width`'s.
    """
    widths = {}
    for (name,), rows in frame.group_by("scene", maintain_order=True):
        scene = str(name)
        widths[scene] = lane_width(rows["y"].to_numpy(), rows["lane"].to_numpy(), scene)
    return widths


def scene_lane_counts(frame: pl.DataFrame) -> dict[str, int]:
    """Number of lanes of every scene of a frame in the schema: its highest lane number plus one."""
    scenes = frame.group_by("scene", maintain_order=True)
    return dict(scenes.agg(pl.col("lane").max() + 1).iter_rows())


def lane_width(y: Floats, lane: Integers, scene: str = "scene") -> float:
    """Lane width, m, at which the nearest lanes agree best with the recorded ones ``lane`` [R].

    The first estimate is the median slope between the median positions of each pair of lanes (Theil
    and Sen), which is robust to outliers. It is kept if no other width within 10 % of it puts more
    rows into their recorded lane; otherwise the result is the middle of the best range. Lane
    changes make that range narrow, since a vehicle's lane number changes just where it crosses the
    boundary.

    Args:
        y: [R] m, 0 at the centre of lane 0.
        lane: [R] as recorded.
        scene: its name, for messages.

    Raises:
        UserError: the estimate is below 2 m or above 6 m.
    """
    # Medians first: they are robust, but drivers off the centre shift them.
    guess = _median_spacing(*_centres(y, lane))
    if guess is None:
        return STANDARD_LANE_WIDTH_M
    if not 2.0 <= guess <= 6.0:
        raise UserError(
            f"{scene}: its lanes are {guess:.2f} m apart, expected 2 to 6 m; check that y is in "
            "metres, grows to the left, and that lanes are numbered in order."
        )

    # Then the range of widths that explains most recorded lane numbers.
    low, high = _best_range(y, lane, guess)
    if low <= guess <= high:
        return guess
    return 0.5 * (low + high)


def lane_grid(y: Floats, lane: Integers, scene: str) -> tuple[float, float]:
    """Lane width (:func:`lane_width`) and position of lane 0's centre, both m, where ``y`` has any
    origin.

    Each lane's median position gives an estimate of the centre; their median is returned.

    Raises:
        UserError: see :func:`lane_width`.
    """
    numbers, centres = _centres(y, lane)
    spacing = _median_spacing(numbers, centres)
    # Estimates of lane 0's centre: of every row where there is one lane, else of every lane.
    estimates = y - lane * STANDARD_LANE_WIDTH_M
    if spacing is not None:
        estimates = centres - numbers * spacing
    centre = float(np.median(estimates))
    return lane_width(y - centre, lane, scene), centre


def _best_range(y: Floats, lane: Integers, guess: float) -> tuple[float, float]:
    """Widths within 10 % of the guess that most rows agree with, from the least to the greatest.

    Of several ranges, the nearest to the guess.
    """
    # A row of lane k agrees with the widths from y / (k + 1/2) to y / (k - 1/2); lane 0 has no
    # upper end.
    limits = (0.9 * guess, 1.1 * guess)
    begin = np.where(lane == 0, 2.0 * np.abs(y), y / (lane + 0.5)).clip(*limits)
    end = np.where(lane == 0, np.inf, y / (lane - 0.5)).clip(*limits)

    # The number of agreeing rows changes at these widths only, so one width between two of them
    # stands for all.
    edges = np.unique(np.concatenate((begin, end, limits)))
    inside = 0.5 * (edges[1:] + edges[:-1])
    # Rows whose range has begun, less those whose range has ended.
    begun = np.searchsorted(np.sort(begin), inside)
    ended = np.searchsorted(np.sort(end), inside)
    agreeing = begun - ended

    best = np.flatnonzero(agreeing == agreeing.max())
    nearest = best[np.argmin(np.abs(inside[best] - guess))]
    return float(edges[nearest]), float(edges[nearest + 1])


def _median_spacing(numbers: Integers, centres: Floats) -> float | None:
    """Median slope between the lanes' median positions; None with fewer than two lanes."""
    if len(numbers) < 2:
        return None
    # All pairs of lanes.
    one, other = np.triu_indices(len(numbers), 1)
    distances = centres[other] - centres[one]
    lanes_apart = numbers[other] - numbers[one]
    return float(np.median(distances / lanes_apart))


def _centres(y: Floats, lane: Integers) -> tuple[Integers, Floats]:
    """Lanes with enough rows (0.5 s of one vehicle), and their median positions."""
    numbers, rows = np.unique(lane, return_counts=True)
    numbers = numbers[rows >= 5]
    medians = np.array([np.median(y[lane == number]) for number in numbers])
    return numbers, medians


@dataclass(frozen=True)
class Tracks:
    """R samples, 0.1 s apart, of any number of tracks, track by track; a missing sample ends a
    track.

    Attributes:
        y: [R] m; lane k's centre is at ``k * lane_width``.
        lane_width: [R] m.
        begins: [R] true at the first sample of each track.
    """

    y: Floats
    lane_width: Floats
    begins: Flags

    @property
    def lane(self) -> Integers:
        """[R] lane whose centre is nearest."""
        return np.rint(self.y / self.lane_width).astype(np.int64)

    @property
    def first(self) -> Integers:
        """[R] index of the first sample of each sample's track."""
        # The greatest beginning so far.
        beginnings = np.where(self.begins, np.arange(len(self.y)), 0)
        return np.maximum.accumulate(beginnings)

    @property
    def last(self) -> Integers:
        """[R] index of the last sample of each sample's track."""
        # A track ends one sample before the next begins.
        ends = np.append(np.flatnonzero(self.begins)[1:], len(self.y)) - 1
        number = np.cumsum(self.begins) - 1
        return ends[number]


def tracks_of_frame(
    frame: pl.DataFrame,
    lane_widths: dict[str, float] | None = None,
) -> Tracks:
    """Tracks of a frame in the schema, sorted.

    Args:
        frame: what is measured; of its columns ``y``, ``scene``, ``vehicle`` and ``frame``.
        lane_widths: of each scene, m; None: they are estimated.
    """
    widths = scene_lane_widths(frame) if lane_widths is None else lane_widths
    # A track goes on where frame and vehicle say so, within one scene; null in the first row.
    is_next_frame = pl.col("frame").diff() == 1
    same_vehicle = pl.col("vehicle").diff() == 0
    same_scene = pl.col("scene") == pl.col("scene").shift(1)
    goes_on = is_next_frame & same_vehicle & same_scene
    columns = frame.select(
        "y",
        width=pl.col("scene").replace_strict(widths, return_dtype=pl.Float64),
        begins=~goes_on.fill_null(False),
    )
    return Tracks(*(column.to_numpy() for column in columns))


@dataclass(frozen=True)
class LaneChanges:
    """C lane changes, in the order of the samples.

    Attributes:
        sample: [C] index of the last sample in the old lane.
        old_lane, new_lane: [C]; 0 is the rightmost.
        tau_s, tau_e: [C] times from the start to the crossing and on to the end, s (equation 11).
        start_censored, end_censored: [C] the track begins or ends first; the time is a lower bound.
        lateral_speed: [C] mean over the recorded part of the change, m/s, positive.
    """

    sample: Integers
    old_lane: Integers
    new_lane: Integers
    tau_s: Floats
    tau_e: Floats
    start_censored: Flags
    end_censored: Flags
    lateral_speed: Floats

    @property
    def duration_s(self) -> Floats:
        """[C] equation 11: ``tau_s + tau_e``; a lower bound where censored."""
        return self.tau_s + self.tau_e

    @property
    def complete(self) -> Flags:
        """[C] true where neither end is censored."""
        return ~(self.start_censored | self.end_censored)

    def __len__(self) -> int:
        return len(self.sample)


def find_lane_changes(tracks: Tracks) -> LaneChanges:
    """All lane changes of ``tracks``.

    The module's docstring defines what counts and how it is timed.
    """
    lane = tracks.lane
    sample = _crossings(lane, tracks)
    old = lane[sample]
    new = lane[sample + 1]
    # 1 to the left, -1 to the right.
    side = np.sign(new - old)

    # The crossing lies between two samples; it is interpolated linearly. ``part`` is the share of
    # the 0.1 s between them.
    boundary = (old + 0.5 * side) * tracks.lane_width[sample]
    y_before = tracks.y[sample]
    y_after = tracks.y[sample + 1]
    part = (boundary - y_before) / (y_after - y_before)

    start, start_seen = _find_end(tracks, sample, side, old, -1)
    end, end_seen = _find_end(tracks, sample + 1, side, new, 1)
    tau_s = (sample - start + part) * FRAME_S
    tau_e = (end - sample - part) * FRAME_S
    # Over the recorded part of the change, from start to end.
    moved = side * (tracks.y[end] - tracks.y[start])
    speed = moved / (tau_s + tau_e)
    return LaneChanges(sample, old, new, tau_s, tau_e, ~start_seen, ~end_seen, speed)


def _crossings(lane: Integers, tracks: Tracks) -> Integers:
    """[C] last samples in an old lane, where both the old and the new lane are kept long enough."""
    # A run is a stretch of one lane within a track.
    starts_run = tracks.begins | (np.diff(lane, prepend=lane[:1]) != 0)
    lengths = np.diff(np.flatnonzero(starts_run), append=len(lane))
    long_enough = lengths >= _HOLD
    # Of each sample, [R]: the number of its run.
    run = np.cumsum(starts_run) - 1
    # Samples at which a new run begins within the same track.
    after = np.flatnonzero(starts_run & ~tracks.begins)
    stays_before = long_enough[run[after - 1]]
    stays_after = long_enough[run[after]]
    return after[stays_before & stays_after] - 1


def _find_end(
    tracks: Tracks,
    sample: Integers,
    side: Integers,
    lane: Integers,
    direction: int,
) -> tuple[Integers, Flags]:
    """Start (``direction`` -1) or end (1) of lane changes.

    It is the first sample that is centred or without lateral movement.

    Args:
        tracks: all samples.
        sample: [C] where the search begins, next to the crossing.
        side: [C] of the change: 1 to the left, -1 to the right.
        lane: [C] the lane that is left or reached.
        direction: of the search in time.

    Returns:
        [C] the samples, or the first or last ones of their tracks, and [C] whether the end lies
        within the track.
    """
    # [C, steps]: the samples that are searched, in this order. Never beyond the track: there the
    # change is censored.
    limit = (tracks.first if direction < 0 else tracks.last)[sample, None]
    path = sample[:, None] + direction * np.arange(_REACH + 1)
    inside = direction * (limit - path) >= 0
    path = np.where(inside, path, limit)

    # Distance from the centre of the lane that is left or reached.
    centre = lane * tracks.lane_width[sample]
    offset = tracks.y[path] - centre[:, None]
    # Towards the new lane; a mean, since recorded positions are noisy.
    pace = side[:, None] * mean_speed(tracks.y, tracks, path)
    is_done = inside & ((np.abs(offset) < _CENTRED_M) | (pace < _STILL_MPS))

    # argmax is the first true entry.
    within = is_done.any(axis=1)
    steps = np.where(within, is_done.argmax(axis=1), inside.sum(axis=1) - 1)
    return sample + direction * steps, within


def mean_speed(position: Floats, tracks: Tracks, at: Integers) -> Floats:
    """Mean speed over 1 s, centred at the samples ``at``, m/s, along the axis of ``position`` [R].

    The window is shorter at a track's ends.
    """
    before = np.maximum(at - _HALF_WINDOW, tracks.first[at])
    after = np.minimum(at + _HALF_WINDOW, tracks.last[at])
    # A track of one sample has no speed: 0.
    samples = np.maximum(after - before, 1)
    return (position[after] - position[before]) / (samples * FRAME_S)
