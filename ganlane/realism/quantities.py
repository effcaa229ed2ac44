"""What is measured of driving, recorded or simulated, by the same lines of code.

Everything is taken from positions, over one second and centred, so that recordings and simulations go through the
same filter: raw recorded speeds and accelerations are mostly noise. A vehicle counts from 3 s after it appears: at
the start everything looks real.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import polars as pl

from ganlane.data import FRAME_S, TRACK, Bins, find_lane_changes, leader_gaps, tracks_of_frame

#: A vehicle's first seconds do not count.
SETTLING_S: Final = 3.0
#: Half of the second that speeds are taken over, and all of it, in frames.
_HALF, _WHOLE = 5, 10
#: Further ahead nobody is followed, m; slower than this a driver shows no headway, m/s.
FOLLOWING_M: Final = 100.0
SLOWEST_FOLLOWER_MPS: Final = 2.0
#: Closing in slower than this, a driver approaches nobody, m/s.
CLOSING_MPS: Final = 0.1
#: Fewest vehicles in a frame whose speeds have a spread.
FEWEST_IN_FRAME: Final = 3

#: Name to bins; what lies beyond counts in the outermost ones. m, s, m/s, m/s2, m/s3.
QUANTITIES: Final[dict[str, Bins]] = {
    "speed": Bins(0.0, 40.0, 40),
    "speed_spread": Bins(0.0, 10.0, 20),
    "acceleration": Bins(-5.0, 5.0, 50),
    "jerk": Bins(-5.0, 5.0, 50),
    "time_headway": Bins(0.0, 8.0, 40),
    "gap": Bins(0.0, 100.0, 40),
    "time_to_collision": Bins(0.0, 30.0, 30),
    "lane_change_duration": Bins(0.0, 10.0, 10),
}
UNITS: Final = {
    "speed": "m/s",
    "speed_spread": "m/s",
    "acceleration": "m/s2",
    "jerk": "m/s3",
    "time_headway": "s",
    "gap": "m",
    "time_to_collision": "s",
    "lane_change_duration": "s",
}


@dataclass(frozen=True)
class Measured:
    """Driving, measured.

    Attributes:
        samples: by quantity, columns ``unit`` and ``value``.
        lane_changes: by unit (those with none may be missing).
        vehicle_km: by unit.
    """

    samples: Mapping[str, pl.DataFrame]
    lane_changes: Mapping[str, int]
    vehicle_km: Mapping[str, float]

    def quantile(self, quantity: str, level: float) -> float | None:
        """Quantile of a quantity over all units; None without samples."""
        value = self.samples[quantity]["value"].quantile(level, "linear")
        return None if value is None else float(value)

    def counts(self, units: Sequence[str], quantity: str) -> np.ndarray:
        """Samples per unit and bin, [units, bins] float64."""
        bins, index = QUANTITIES[quantity], {unit: row for row, unit in enumerate(units)}
        table = self.samples[quantity].filter(pl.col("unit").is_in(list(units)))
        row = table["unit"].replace_strict(index, return_dtype=pl.Int64).to_numpy()
        share = (table["value"].to_numpy() - bins.low) / (bins.high - bins.low)
        column = np.clip(np.floor(share * bins.number), 0, bins.number - 1).astype(np.int64)
        flat = np.bincount(row * bins.number + column, minlength=len(units) * bins.number)
        return flat.reshape(len(units), bins.number).astype(np.float64)


def measure(frame: pl.DataFrame, lane_widths: Mapping[str, float]) -> Measured:
    """Measure trajectories.

    Args:
        frame: as :func:`ganlane.realism.recordings.frame_of` gives it, sorted by track.
        lane_widths: m, by scene.
    """
    motion = _motion(frame)
    own = motion.filter(pl.col("counts"))
    followers = _followers(motion)
    closing = pl.col("speed") - pl.col("leader_speed")
    crowded = own.drop_nulls("speed").group_by("unit", "scene", "frame").agg(pl.col("speed").std(), pl.len())
    changes, made = _lane_changes(motion, lane_widths)
    samples = {
        "speed": _values(own, pl.col("speed")),
        "speed_spread": _values(crowded.filter(pl.col("len") >= FEWEST_IN_FRAME), pl.col("speed")),
        "acceleration": _values(own, pl.col("acceleration")),
        "jerk": _values(own, pl.col("jerk")),
        "time_headway": _values(
            followers.filter(pl.col("speed") >= SLOWEST_FOLLOWER_MPS), pl.col("gap") / pl.col("speed")
        ),
        "gap": _values(followers, pl.col("gap")),
        "time_to_collision": _values(followers.filter(closing > CLOSING_MPS), pl.col("gap") / closing),
        "lane_change_duration": changes,
    }
    km = own.group_by("unit").agg((pl.col("stride").sum() / 1000.0).alias("km"))
    return Measured(samples, made, dict(km.iter_rows()))


def _at(column: str, frames: int) -> pl.Expr:
    """The column's value ``frames`` later in the same track."""
    return pl.col(column).shift(-frames).over(TRACK)


def _motion(frame: pl.DataFrame) -> pl.DataFrame:
    """``frame`` with speed, acceleration and jerk over 1 s, the step driven, and whether the row counts."""
    speed = (_at("x", _HALF) - _at("x", -_HALF)) / (_WHOLE * FRAME_S)
    bend = _at("x", _WHOLE) - 2.0 * pl.col("x") + _at("x", -_WHOLE)
    late, later = _HALF, _HALF + _WHOLE
    swing = _at("x", later) - 3.0 * _at("x", late) + 3.0 * _at("x", -late) - _at("x", -later)
    age = pl.col("frame") - pl.col("frame").first().over(TRACK)
    return frame.with_columns(
        speed=speed,
        acceleration=bend / (_WHOLE * FRAME_S) ** 2,
        jerk=swing / (_WHOLE * FRAME_S) ** 3,
        stride=pl.col("x") - _at("x", -1),
        counts=(age >= round(SETTLING_S / FRAME_S)) & pl.col("driven"),
    )


def _followers(motion: pl.DataFrame) -> pl.DataFrame:
    """Rows that count and have a leader near enough, neither overlapping it nor without a speed."""
    near = pl.col("gap").is_between(0.0, FOLLOWING_M)
    return leader_gaps(motion).filter(pl.col("counts") & near).drop_nulls(["speed", "leader_speed"])


def _lane_changes(motion: pl.DataFrame, lane_widths: Mapping[str, float]) -> tuple[pl.DataFrame, dict[str, int]]:
    """Durations of the changes that cross in a row that counts, censored ones as far as seen; and their numbers.

    Simulations run where and as long as the recordings do, so both are cut off alike.
    """
    changes = find_lane_changes(tracks_of_frame(motion, dict(lane_widths)))
    rows = motion[changes.sample].select("unit", "counts").with_columns(value=pl.Series(changes.duration_s))
    counted = rows.filter(pl.col("counts")).select("unit", "value")
    return counted, dict(counted.group_by("unit").len().iter_rows())


def _values(rows: pl.DataFrame, value: pl.Expr) -> pl.DataFrame:
    return rows.select("unit", value.alias("value")).drop_nulls().filter(pl.col("value").is_finite())
