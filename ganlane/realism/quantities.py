"""What is measured of driving, recorded or simulated, by the same lines of code.

Everything is taken from positions, over one second and centred, so that recordings and simulations go through the
same filter: raw recorded speeds and accelerations are mostly noise. A vehicle counts from 3 s after it appears: at
the start everything looks real.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import polars as pl

from ganlane.data import FRAME_S, TRACK, Bins, find_lane_changes, leader_gaps, tracks_of_frame
from ganlane.evaluation.statistics import Array, entries, poisson_interval
from ganlane.realism.recordings import Recording, recorded_frame, units_of

#: A vehicle's first seconds do not count.
SETTLING_S: Final = 3.0
#: Half of the second that speeds are taken over, and all of it, in frames.
_HALF, _WHOLE = 5, 10
#: Leaders further ahead are ignored, m; slower than this a driver shows no headway, m/s.
FOLLOWING_M: Final = 100.0
SLOWEST_FOLLOWER_MPS: Final = 2.0
#: Closing in slower than this, a driver approaches nobody, m/s.
CLOSING_MPS: Final = 0.1
#: Fewest vehicles in a frame whose speeds have a spread.
FEWEST_IN_FRAME: Final = 3
#: Levels of the quantiles.
LEVELS: Final = (0.05, 0.5, 0.95)

_QUANTITIES: Final = {
    "speed": ("m/s", Bins(0.0, 40.0, 40)),
    "speed_spread": ("m/s", Bins(0.0, 10.0, 20)),
    "acceleration": ("m/s2", Bins(-5.0, 5.0, 50)),
    "jerk": ("m/s3", Bins(-5.0, 5.0, 50)),
    "time_headway": ("s", Bins(0.0, 8.0, 40)),
    "gap": ("m", Bins(0.0, 100.0, 40)),
    "time_to_collision": ("s", Bins(0.0, 30.0, 30)),
    "lane_change_duration": ("s", Bins(0.0, 10.0, 10)),
}
#: By quantity, its unit, and its bins; values beyond count in the outermost ones.
UNITS: Final = {name: unit for name, (unit, _) in _QUANTITIES.items()}
QUANTITIES: Final = {name: bins for name, (_, bins) in _QUANTITIES.items()}


@dataclass(frozen=True)
class Measured:
    """Driving, measured.

    Attributes:
        samples: by quantity, columns ``unit`` and ``value``.
        counts: by quantity, samples per unit and bin, [units, bins].
        lane_changes, vehicle_km: of all units.
    """

    samples: Mapping[str, pl.DataFrame]
    counts: Mapping[str, Array]
    lane_changes: int
    vehicle_km: float

    def summary(self) -> dict[str, Any]:
        """Lane changes per vehicle-km (:func:`lane_change_rate`) and the ``quantiles`` of every quantity."""
        return {**lane_change_rate(self.lane_changes, self.vehicle_km), "quantiles": self.quantiles()}

    def quantile(self, quantity: str, level: float) -> float | None:
        """Quantile of a quantity over all units; None without samples."""
        return self.samples[quantity]["value"].quantile(level, "linear")

    def quantiles(self) -> dict[str, dict[str, float | None]]:
        """By quantity, the quantiles at :data:`LEVELS`."""
        return {name: {f"{level:g}": self.quantile(name, level) for level in LEVELS} for name in QUANTITIES}

    def restricted_to(self, rows: Sequence[int]) -> Measured:
        """The same with the counts of some units only; samples and totals remain those of all."""
        return replace(self, counts={name: counts[rows] for name, counts in self.counts.items()})

    @staticmethod
    def joined(parts: Sequence[Measured]) -> Measured:
        """Driving of different units, one below the other."""
        samples = {name: pl.concat([part.samples[name] for part in parts]) for name in QUANTITIES}
        counts = {name: np.concatenate([part.counts[name] for part in parts]) for name in QUANTITIES}
        return Measured(samples, counts, sum(p.lane_changes for p in parts), sum(p.vehicle_km for p in parts))


def lane_change_rate(changes: int, km: float) -> dict[str, Any]:
    """Lane changes, vehicle-km, and their ratio with its exact 95 % interval."""
    ratio = poisson_interval(changes).scaled(per=km) if km else None
    return {"lane_changes": changes, "vehicle_km": km, **entries("per_vehicle_km", ratio)}


def measure_recordings(recordings: Sequence[Recording]) -> Measured:
    """The recordings, measured as simulations are."""
    return measure(recorded_frame(recordings), units_of(recordings))


def measure(frame: pl.DataFrame, units: Sequence[str]) -> Measured:
    """Measure trajectories.

    Args:
        frame: as :func:`ganlane.realism.recordings.frame_of` gives it, sorted by track.
        units: what the bootstrap resamples, in the order of the rows of ``counts``.
    """
    motion = _motion(frame)
    own = motion.filter(pl.col("counts"))
    followers = _followers(motion)
    closing = pl.col("speed") - pl.col("leader_speed")
    crowded = own.drop_nulls("speed").group_by("unit", "scene", "frame").agg(pl.col("speed").std(), pl.len())
    fast_enough = followers.filter(pl.col("speed") >= SLOWEST_FOLLOWER_MPS)
    changes = _lane_changes(motion)
    samples = {
        "speed": _values(own, pl.col("speed")),
        "speed_spread": _values(crowded.filter(pl.col("len") >= FEWEST_IN_FRAME), pl.col("speed")),
        "acceleration": _values(own, pl.col("acceleration")),
        "jerk": _values(own, pl.col("jerk")),
        "time_headway": _values(fast_enough, pl.col("gap") / pl.col("speed")),
        "gap": _values(followers, pl.col("gap")),
        "time_to_collision": _values(followers.filter(closing > CLOSING_MPS), pl.col("gap") / closing),
        "lane_change_duration": changes,
    }
    counts = {name: _histograms(table, units, QUANTITIES[name]) for name, table in samples.items()}
    km = own.group_by("unit").agg((pl.col("stride").sum() / 1000.0).alias("km"))
    return Measured(samples, counts, changes.height, sum(km["km"].to_list()))


def _histograms(table: pl.DataFrame, units: Sequence[str], bins: Bins) -> Array:
    """Samples per unit and bin, [units, bins]."""
    index = {unit: row for row, unit in enumerate(units)}
    table = table.filter(pl.col("unit").is_in(list(units)))
    row = table["unit"].replace_strict(index, return_dtype=pl.Int64).to_numpy()
    share = (table["value"].to_numpy() - bins.low) / (bins.high - bins.low)
    column = np.clip(np.floor(share * bins.number), 0, bins.number - 1).astype(np.int64)
    flat = np.bincount(row * bins.number + column, minlength=len(units) * bins.number)
    return flat.reshape(len(units), bins.number).astype(np.float64)


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


def _lane_changes(motion: pl.DataFrame) -> pl.DataFrame:
    """Unit and duration of the changes that cross in a row that counts, censored ones as far as seen.

    Simulations run where and as long as the recordings do, so both are cut off alike.
    """
    widths = dict(motion.select("scene", "lane_width").unique().iter_rows())
    changes = find_lane_changes(tracks_of_frame(motion, widths))
    rows = motion[changes.sample].select("unit", "counts").with_columns(value=pl.Series(changes.duration_s))
    return rows.filter(pl.col("counts")).select("unit", "value")


def _values(rows: pl.DataFrame, value: pl.Expr) -> pl.DataFrame:
    return rows.select("unit", value.alias("value")).drop_nulls().filter(pl.col("value").is_finite())
