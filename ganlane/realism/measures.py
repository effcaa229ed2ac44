"""What is measured of driving, recorded or simulated, and how far two distributions are apart, with
intervals.

Everything is taken from positions, over one second and centred, so that recordings and simulations
go through the same filter: raw recorded speeds and accelerations are mostly noise. A vehicle counts
from 3 s after it appears: at the start everything looks real.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl
from scipy.special import stdtrit

from ganlane.data import FRAME_S, TRACK, Bins, find_lane_changes, leader_gaps, tracks_of_frame
from ganlane.errors import UserError
from ganlane.evaluation.statistics import (
    TAIL_LEVELS,
    Array,
    Estimate,
    entries,
    poisson_interval,
    resample_counts,
)
from ganlane.files import CHECKPOINTS, PLACE, has_checksum, refuse_without_checksum, write_json
from ganlane.realism.recordings import Recording, recorded_frame, units_of

#: Recorded driving as histograms, which ships; it holds derived numbers, never an excerpt of a
#: recording.
SHIPPED_REFERENCE = CHECKPOINTS / "realism_us101.json"
_KIND = "ganlane realism reference"
RESAMPLES = 2_000
#: Random halves of the recordings that the ceiling is the mean of.
SPLITS = 200
_TINY = 1e-300
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


def jensen_shannon(first: Array, second: Array) -> Array:
    """Jensen-Shannon distance of histograms [..., bins]: 0 for equal ones, 1 for disjoint ones (Lin
    1991).

    The square root of the divergence to base 2, which is a metric (Endres and Schindelin 2003). NaN
    where either histogram is empty.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        p, q = first / first.sum(-1, keepdims=True), second / second.sum(-1, keepdims=True)
    middle = 0.5 * (p + q)

    def information(share: Array) -> Array:
        return np.sum(
            share * (np.log2(np.maximum(share, _TINY)) - np.log2(np.maximum(middle, _TINY))),
            axis=-1,
        )

    return np.sqrt(np.clip(0.5 * (information(p) + information(q)), 0.0, 1.0))


def pooled_distance(simulated: Array, recorded: Array) -> float:
    """Distance of two sets of histograms [units, bins], each added up over its units."""
    return float(jensen_shannon(simulated.sum(0), recorded.sum(0)))


def distance(
    simulated: Array, recorded: Array, paired: bool = True, resamples: int = RESAMPLES
) -> Estimate:
    """Distance with its 95 % bootstrap interval over units; both are [units, bins]. One unit gives
    no interval.

    A resample holds some units twice and others not at all, so its distance is biased upwards; near
    0 all of them lie above the estimate. Hence the basic (reverse percentile) interval, taken of
    the squared distance, in which that bias adds up, cut off at 0 and widened to hold the estimate.
    Percentile and BCa intervals consist of resamples, none of which is 0, so they miss a perfect
    model's distance (docs/realism.md).

    ``paired`` units are the same and are resampled together; else ``simulated`` alone is.
    """
    value = pooled_distance(simulated, recorded)
    (drawn,) = _resampled((simulated,), recorded, paired, resamples)
    known = drawn[np.isfinite(drawn)]
    if not np.isfinite(value) or len(known) < 2:
        return Estimate(value)
    tails = np.quantile(known**2, TAIL_LEVELS)
    low, high = np.sqrt(np.maximum(2.0 * value**2 - tails[::-1], 0.0))
    return Estimate(value, min(value, float(low)), min(1.0, max(value, float(high))))


def distance_difference(
    first: Array, second: Array, recorded: Array, paired: bool = True, resamples: int = RESAMPLES
) -> Estimate:
    """Distance of ``first`` less that of ``second`` to ``recorded``, with its 95 % interval; see
    :func:`distance`.

    Both are of the same units and resampled together. The interval is Student's, from the
    bootstrap's standard error of the difference in squared distance, in which the bias of both
    mostly cancels, divided by the sum of the distances: (a^2 - b^2) / (a + b) = a - b. With four
    units the basic and the percentile interval find one of two equally good models closer too
    often.
    """
    one, other = pooled_distance(first, recorded), pooled_distance(second, recorded)
    ours, theirs = _resampled((first, second), recorded, paired, resamples)
    known = (ours**2 - theirs**2)[np.isfinite(ours) & np.isfinite(theirs)]
    units, value = len(first), one - other
    if not np.isfinite(value) or len(known) < 2:
        return Estimate(value)
    error = float(known.std()) * np.sqrt(units / (units - 1))
    reach = float(stdtrit(units - 1, TAIL_LEVELS[1])) * error / max(one + other, _TINY)
    return Estimate(value, max(-1.0, value - reach), min(1.0, value + reach))


def _resampled(
    models: Sequence[Array], recorded: Array, paired: bool, resamples: int
) -> list[Array]:
    """Distances [R] of each of ``models`` from resampled units, the same ones for all.

    None of a single unit.
    """
    units = len(recorded) if paired else len(models[0])
    if units < 2:
        return [np.empty(0) for _ in models]
    drawn: list[list[Array]] = [[] for _ in models]
    for counts in resample_counts(units, resamples, seed=0):
        against = counts @ recorded if paired else recorded.sum(0)
        for values, model in zip(drawn, models):
            values.append(jensen_shannon(counts @ model, against))
    return [np.concatenate(values) for values in drawn]


def ceiling(recorded: Array) -> float | None:
    """Mean distance of one half of the units [units, bins] to the other, over random halves; None
    for one unit.

    What no model can be expected to beat: halves hold half of the driving, so it errs on the high
    side.
    """
    units = len(recorded)
    if units < 2:
        return None
    generator = np.random.default_rng(0)
    one = np.zeros((SPLITS, units))
    for row in one:
        row[generator.permutation(units)[: units // 2]] = 1.0
    values = jensen_shannon(one @ recorded, (1.0 - one) @ recorded)
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None


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
        """Lane changes per vehicle-km (:func:`lane_change_rate`) and the ``quantiles`` of every
        quantity.
        """
        return {
            **lane_change_rate(self.lane_changes, self.vehicle_km),
            "quantiles": self.quantiles(),
        }

    def quantile(self, quantity: str, level: float) -> float | None:
        """Quantile of a quantity over all units; None without samples."""
        return self.samples[quantity]["value"].quantile(level, "linear")

    def quantiles(self) -> dict[str, dict[str, float | None]]:
        """By quantity, the quantiles at :data:`LEVELS`."""
        return {
            name: {f"{level:g}": self.quantile(name, level) for level in LEVELS}
            for name in QUANTITIES
        }

    def restricted_to(self, rows: Sequence[int]) -> Measured:
        """The same with the counts of some units only; samples and totals remain those of all."""
        return replace(self, counts={name: counts[rows] for name, counts in self.counts.items()})

    @staticmethod
    def joined(parts: Sequence[Measured]) -> Measured:
        """Driving of different units, one below the other."""
        samples = {name: pl.concat([part.samples[name] for part in parts]) for name in QUANTITIES}
        counts = {
            name: np.concatenate([part.counts[name] for part in parts]) for name in QUANTITIES
        }
        return Measured(
            samples, counts, sum(p.lane_changes for p in parts), sum(p.vehicle_km for p in parts)
        )


def lane_change_rate(changes: int, km: float) -> dict[str, Any]:
    """Lane changes, vehicle-km, and their ratio with its exact 95 % interval."""
    ratio = poisson_interval(changes).scaled(per=km) if km else None
    return {"lane_changes": changes, "vehicle_km": km, **entries("per_vehicle_km", ratio)}


def measure_recordings(recordings: Sequence[Recording]) -> Measured:
    """The recordings, measured as simulations are."""
    return measure(recorded_frame(recordings), units_of(recordings))


def measure(frame: pl.DataFrame, units: Sequence[str]) -> Measured:
    """Measure trajectories, as :func:`ganlane.realism.recordings.frame_of` gives them.

    ``units`` are the rows.
    """
    motion = _motion(frame)
    own = motion.filter(pl.col("counts"))
    near = pl.col("counts") & pl.col("gap").is_between(0.0, FOLLOWING_M)
    followers = leader_gaps(motion).filter(near).drop_nulls(["speed", "leader_speed"])
    closing = pl.col("speed") - pl.col("leader_speed")
    crowded = (
        own.drop_nulls("speed")
        .group_by("unit", "scene", "frame")
        .agg(pl.col("speed").std(), pl.len())
    )
    fast_enough = followers.filter(pl.col("speed") >= SLOWEST_FOLLOWER_MPS)
    changes = _lane_changes(motion)
    values = {
        "speed": (own, pl.col("speed")),
        "speed_spread": (crowded.filter(pl.col("len") >= FEWEST_IN_FRAME), pl.col("speed")),
        "acceleration": (own, pl.col("acceleration")),
        "jerk": (own, pl.col("jerk")),
        "time_headway": (fast_enough, pl.col("gap") / pl.col("speed")),
        "gap": (followers, pl.col("gap")),
        "time_to_collision": (followers.filter(closing > CLOSING_MPS), pl.col("gap") / closing),
    }
    samples = {
        name: rows.select("unit", value=value).drop_nulls().filter(pl.col("value").is_finite())
        for name, (rows, value) in values.items()
    }
    samples["lane_change_duration"] = changes
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
    """``frame`` with speed, acceleration and jerk over 1 s, the step driven, and whether the row
    counts.
    """
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


def _lane_changes(motion: pl.DataFrame) -> pl.DataFrame:
    """Unit and duration of the changes that cross in a row that counts, censored ones as far as
    seen.

    Simulations run where and as long as the recordings do, so both are cut off alike.
    """
    widths = dict(motion.select("scene", "lane_width").unique().iter_rows())
    changes = find_lane_changes(tracks_of_frame(motion, widths))
    rows = (
        motion[changes.sample]
        .select("unit", "counts")
        .with_columns(value=pl.Series(changes.duration_s))
    )
    return rows.filter(pl.col("counts")).select("unit", "value")


@dataclass(frozen=True)
class Reference:
    """Recorded driving as histograms and rates.

    Attributes:
        source: where it was recorded.
        units: names of the scenes.
        counts: by quantity, [units, bins].
        quantiles: by quantity, by level as text.
        lane_changes, vehicle_km: from 3 s after each vehicle's first frame.
        whole: lane changes and vehicle-km of all frames, and ``speed_spread_mps``; long runs are
            compared with these.
        floors: by driver (``random``, ``constant_velocity``), by quantity: its distance from here.
    """

    source: str
    units: list[str]
    counts: Mapping[str, Array]
    quantiles: Mapping[str, Mapping[str, float | None]]
    lane_changes: int
    vehicle_km: float
    whole: Mapping[str, float]
    floors: Mapping[str, Mapping[str, float]]

    @classmethod
    def of(
        cls, measured: Measured, units: Sequence[str], whole: Mapping[str, float], source: str
    ) -> Reference:
        """The reference that measured recordings give, without floors."""
        changes, km = measured.lane_changes, measured.vehicle_km
        return cls(
            source,
            list(units),
            measured.counts,
            measured.quantiles(),
            changes,
            km,
            whole,
            floors={},
        )

    def summary(self) -> dict[str, Any]:
        """As :meth:`Measured.summary`."""
        return {**lane_change_rate(self.lane_changes, self.vehicle_km), "quantiles": self.quantiles}

    @property
    def spread_mps(self) -> float:
        """Recorded spread of speeds within a frame, its mean over the frames, m/s."""
        return self.whole["speed_spread_mps"]

    def rate(self) -> dict[str, Any]:
        """Lane changes per vehicle-km of the whole recording, with its exact interval."""
        return lane_change_rate(int(self.whole["lane_changes"]), self.whole["vehicle_km"])

    def save(self, path: Path) -> None:
        """Write as JSON, atomically."""
        ceilings = {quantity: ceiling(counts) for quantity, counts in self.counts.items()}
        plain = {
            **vars(self),
            "counts": {name: value.astype(int).tolist() for name, value in self.counts.items()},
        }
        write_json(
            path, {"kind": _KIND, "checksum": PLACE, "bins": _bins(), "ceilings": ceilings, **plain}
        )

    @classmethod
    def load(cls, path: Path) -> Reference:
        """What :meth:`save` wrote.

        Raises:
            UserError: no such file, a damaged one, another file, or one with other bins.
        """
        try:
            content = path.read_bytes()
            whole = has_checksum(content, path)
            numbers = json.loads(content)
            if numbers.pop("kind") != _KIND:
                raise ValueError("another kind of file")
            if numbers.pop("bins") != _bins():
                raise ValueError("its histograms have other bins")
            for derived in ("ceilings", "checksum"):
                numbers.pop(derived, None)
            counts = {
                name: np.asarray(value, dtype=np.float64)
                for name, value in numbers.pop("counts").items()
            }
            reference = cls(counts=counts, **numbers)
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise UserError(
                f"{path}: not the histograms of recorded driving that the realism card needs ({error}); give the "
                "recordings with data.path=FILE."
            ) from error
        if not whole:
            refuse_without_checksum(path)
        return reference


def _bins() -> dict[str, list[float]]:
    """Low edge, high edge and number of the bins, by quantity."""
    return {name: [bins.low, bins.high, bins.number] for name, bins in QUANTITIES.items()}
