"""Tracks at one frame rate, read off between their frames at another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ganlane.data.schema import FRAME_S
from ganlane.data.tracks import Floats, Integers


@dataclass(frozen=True)
class Resampling:
    """Where each of R new samples lies among the old ones.

    Attributes:
        frame: [R] new frame numbers, of 0.1 s; frame 0 is the old frame 0.
        before, after: [R] indices of the old samples around it (the same one where it falls on a sample).
        share: [R] how far it lies from the first to the second, 0 to below 1.
    """

    frame: Integers
    before: Integers
    after: Integers
    share: Floats

    def linear(self, values: Floats) -> Floats:
        """[R] values between the old samples."""
        return values[self.before] + self.share * (values[self.after] - values[self.before])

    def nearest(self, values: Integers) -> Integers:
        """[R] values of the old sample that is nearest; of two the earlier."""
        return values[np.where(self.share > 0.5, self.after, self.before)]


def resampling(begins: np.ndarray, frame: Integers, rate_hz: float) -> Resampling:
    """Samples every 0.1 s within each track, none beyond its ends.

    Args:
        begins: [S] true at the first sample of each track; within a track frames grow by one.
        frame: [S] frame numbers at ``rate_hz``.
        rate_hz: frames a second of the old samples.
    """
    starts = np.flatnonzero(begins)
    ends = np.append(starts[1:], len(frame)) - 1
    per_step = rate_hz * FRAME_S
    # A little slack, so that a frame that falls on a sample counts whatever the rounding.
    first = np.ceil(frame[starts] / per_step - 1e-9).astype(np.int64)
    last = np.floor(frame[ends] / per_step + 1e-9).astype(np.int64)
    samples = np.maximum(last - first + 1, 0)
    track = np.repeat(np.arange(len(starts)), samples)
    offset = np.arange(len(track)) - np.repeat(np.cumsum(samples) - samples, samples)
    new = first[track] + offset
    place = new * per_step - frame[starts][track]
    whole = np.floor(place + 1e-9)
    before = starts[track] + whole.astype(np.int64)
    return Resampling(new, before, np.minimum(before + 1, ends[track]), np.clip(place - whole, 0.0, 1.0))
