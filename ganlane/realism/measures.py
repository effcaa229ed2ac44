"""What is measured of driving, recorded or simulated, and the distance of two distributions.

Everything is taken from positions, over one second and centred, so that recordings and simulations
go through the same filter: raw recorded speeds and accelerations are mostly noise. A vehicle counts
from 3 s after it appears: at the start everything looks real.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl
from scipy.special import stdtrit

from ganlane.data.dense import Recording, units_of
from ganlane.data.lanes import find_lane_changes, tracks_of_frame
from ganlane.data.schema import FRAME_S, TRACK
from ganlane.data.statistics import leader_gaps
from ganlane.errors import UserError
from ganlane.evaluation.statistics import (
    TAIL_LEVELS,
    Array,
    Estimate,
    entries,
    poisson_interval,
    resample_counts,
)
from ganlane.files import (
    CHECKPOINTS,
    PLACE,
    has_checksum,
    read_whole,
    refuse_without_checksum,
    write_json,
)

#: Recorded driving as histograms, which ships; it holds derived numbers, never an excerpt of a
#: recording.
SHIPPED_REFERENCE = CHECKPOINTS / "realism_us101.json"
_KIND = "ganlane realism reference"
#: Of the bootstrap over units.
RESAMPLES = 2_000
#: Random halves of the recordings that the ceiling is the mean of.
SPLITS = 200
#: Stands in for 0 where a logarithm or a quotient would be infinite.
_TINY = 1e-300
#: A vehicle's first seconds do not count.
SETTLING_S: Final = 3.0
#: Half of the second that speeds are taken over, and all of it, in frames.
_HALF = 5
_WHOLE = 10
#: Leaders further ahead are ignored, m.
FOLLOWING_M: Final = 100.0
#: Slower than this a driver shows no headway, m/s.
SLOWEST_FOLLOWER_MPS: Final = 2.0
#: Closing in slower than this, a driver approaches nobody, m/s.
CLOSING_MPS: Final = 0.1
#: Fewest vehicles in a frame whose speeds have a spread.
FEWEST_IN_FRAME: Final = 3
#: Levels of the quantiles.
LEVELS: Final = (0.05, 0.5, 0.95)


@dataclass(frozen=True)
class Quantity:
    """A quantity's ``unit``, and its bins of equal width from ``low`` to ``high``.

    Values beyond are counted in the outermost bins.
    """

    unit: str
    low: float
    high: float
    bins: int

    @property
    def edges(self) -> np.ndarray:
        """The bins' limits [bins + 1]."""
        return np.linspace(self.low, self.high, self.bins + 1)


#: What is measured, by name.
QUANTITIES: Final = {
    "speed": Quantity("m/s", 0.0, 40.0, 40),
    "speed_spread": Quantity("m/s", 0.0, 10.0, 20),
    "acceleration": Quantity("m/s2", -5.0, 5.0, 50),
    "jerk": Quantity("m/s3", -5.0, 5.0, 50),
    "time_headway": Quantity("s", 0.0, 8.0, 40),
    "gap": Quantity("m", 0.0, 100.0, 40),
    "time_to_collision": Quantity("s", 0.0, 30.0, 30),
    "lane_change_duration": Quantity("s", 0.0, 10.0, 10),
}


def jensen_shannon(first: Array, second: Array) -> Array:
    """Jensen-Shannon distance of histograms [..., bins] (Lin 1991): 0 equal, 1 disjoint.

    The square root of the divergence to base 2, which is a metric (Endres and Schindelin 2003). NaN
    where either histogram is empty. scipy's ``jensenshannon`` is NaN where rounding makes the
    divergence of equal histograms negative.
    """
    # Counts to shares; an empty histogram gives NaN.
    with np.errstate(invalid="ignore", divide="ignore"):
        p = first / first.sum(-1, keepdims=True)
        q = second / second.sum(-1, keepdims=True)

    # 0 log 0 is 0: tiny numbers stand in for empty bins.
    log_middle = np.log2(np.maximum(0.5 * (p + q), _TINY))

    def information(share: Array) -> Array:
        """Kullback-Leibler divergence of ``share`` from the middle, bits."""
        log_share = np.log2(np.maximum(share, _TINY))
        return np.sum(share * (log_share - log_middle), axis=-1)

    divergence = 0.5 * (information(p) + information(q))
    # Rounding may lead a little out of the range.
    return np.sqrt(np.clip(divergence, 0.0, 1.0))


def pooled_distance(simulated: Array, recorded: Array) -> float:
    """Distance of two sets of histograms [units, bins], each added up over its units.

    NaN where either has no samples.
    """
    return float(jensen_shannon(simulated.sum(0), recorded.sum(0)))


def distance(
    simulated: Array,
    recorded: Array,
    paired: bool = True,
    resamples: int = RESAMPLES,
) -> Estimate:
    """Distance with its 95 % bootstrap interval over units.

    A resample holds some units twice and others not at all, so its distance is biased upwards; near
    0 all of them lie above the estimate. Hence the basic (reverse percentile) interval, taken of
    the squared distance, in which that bias adds up, cut off at 0 and widened to hold the estimate.
    Percentile and BCa intervals consist of resamples, none of which is 0, so they miss a perfect
    model's distance.

    Args:
        simulated, recorded: counts, [units, bins].
        paired: the units of both are the same, and are resampled together; else ``simulated``
            alone is.
        resamples: of the bootstrap.

    Returns:
        One unit gives no interval; NaN where either has no samples.
    """
    # Units are pooled: a scene has too few samples of its own for a histogram.
    value = pooled_distance(simulated, recorded)
    (drawn,) = _resampled([simulated], recorded, paired, resamples)
    if not np.isfinite(value) or len(drawn) < 2:
        return Estimate(value)

    # Both tails of the squared distance are reflected about the estimate.
    tails = np.quantile(drawn**2, TAIL_LEVELS)
    reflected = 2.0 * value**2 - tails[::-1]
    low, high = np.sqrt(np.maximum(reflected, 0.0))
    return Estimate(value, min(value, float(low)), min(1.0, max(value, float(high))))


def distance_difference(
    first: Array,
    second: Array,
    recorded: Array,
    paired: bool = True,
    resamples: int = RESAMPLES,
) -> Estimate:
    """Distance of ``first`` less that of ``second`` to ``recorded``, with its 95 % interval.

    Both are of the same units and resampled together (:func:`distance`). The interval is Student's,
    from the bootstrap's standard error of the difference in squared distance, in which the bias of
    both mostly cancels, divided by the sum of the distances: (a^2 - b^2) / (a + b) = a - b. With
    four units the basic and the percentile interval find one of two equally good models closer too
    often.

    Args:
        first, second, recorded: counts, [units, bins].
        paired, resamples: as in :func:`distance`.
    """
    one = pooled_distance(first, recorded)
    other = pooled_distance(second, recorded)
    value = one - other
    ours, theirs = _resampled([first, second], recorded, paired, resamples)
    if not np.isfinite(value) or len(ours) < 2:
        return Estimate(value)

    # S resampled units have (S - 1) / S of the variance that they should have.
    units = len(first)
    error = float((ours**2 - theirs**2).std()) * np.sqrt(units / (units - 1))
    # From squared distances to distances: two equal models at 0 would divide by zero.
    quantile = float(stdtrit(units - 1, TAIL_LEVELS[1]))
    reach = quantile * error / max(one + other, _TINY)
    return Estimate(value, max(-1.0, value - reach), min(1.0, value + reach))


def _resampled(models: Sequence[Array], recorded: Array, paired: bool, resamples: int) -> Array:
    """Bootstrapped distances of several models to the recordings.

    Args:
        models, recorded: counts, [units, bins] each.
        paired: resample the units of all together; else those of the models alone.
        resamples: how many are drawn.

    Returns:
        [models, R], of the R resamples in which all distances are known; R is 0 for a single unit.
    """
    units = len(recorded) if paired else len(models[0])
    if units < 2:
        return np.empty((len(models), 0))

    # The same resamples for all models, so that differences are paired.
    counts = np.concatenate(list(resample_counts(units, resamples)))
    against = counts @ recorded if paired else recorded.sum(0)
    distances = np.stack([jensen_shannon(counts @ model, against) for model in models])

    # A resample of units without samples has no distance.
    return distances[:, np.isfinite(distances).all(0)]


def ceiling(recorded: Array) -> float | None:
    """Mean distance of one half of the units [units, bins] to the other, over random halves.

    What no model can be expected to beat: halves hold half of the driving, so it errs on the high
    side.

    Returns:
        None for one unit, and where no half has samples.
    """
    units = len(recorded)
    if units < 2:
        return None

    # A row is a split: 1 for the units of its first half.
    generator = np.random.default_rng(0)
    half = np.zeros((SPLITS, units))
    for row in half:
        first_half = generator.permutation(units)[: units // 2]
        row[first_half] = 1.0

    # All splits at once: [splits, units] times [units, bins].
    values = jensen_shannon(half @ recorded, (1.0 - half) @ recorded)
    # A half without samples has no distance.
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None


@dataclass(frozen=True)
class Measured:
    """Driving, measured.

    Attributes:
        counts: by quantity, samples per unit and bin, [units, bins].
        quantiles: by quantity, by level as text; None without samples.
        lane_changes: of all units, from 3 s after each vehicle's first frame.
        vehicle_km: driven meanwhile.
    """

    counts: Mapping[str, Array]
    quantiles: Mapping[str, Mapping[str, float | None]]
    lane_changes: int
    vehicle_km: float

    def summary(self) -> dict[str, Any]:
        """Lane changes per vehicle-km (:func:`lane_change_rate`) and the ``quantiles``.

        What ``results.json`` holds of it, beside the distances.
        """
        return {
            **lane_change_rate(self.lane_changes, self.vehicle_km),
            "quantiles": self.quantiles,
        }

    def restricted_to(self, rows: Sequence[int]) -> Measured:
        """The same with the counts of some units only; the rest remains that of all.

        ``rows`` are the places of the units in the counts.
        """
        restricted = {name: counts[rows] for name, counts in self.counts.items()}
        return replace(self, counts=restricted)


def rate_entries(name: str, events: int, km: float, per_km: float = 1.0) -> dict[str, Any]:
    """``events`` per ``per_km`` vehicle-km with their exact 95 % interval, by :func:`entries`.

    ``km`` were driven; None where no vehicle moved.
    """
    rate = None
    if km > 0.0:
        rate = poisson_interval(events).scaled(per_km, per=km)
    return entries(name, rate)


def lane_change_rate(changes: int, km: float) -> dict[str, Any]:
    """Lane changes, vehicle-km, and their ratio with its exact 95 % interval."""
    return {
        "lane_changes": changes,
        "vehicle_km": km,
        **rate_entries("per_vehicle_km", changes, km),
    }


def measure(recordings: Sequence[Recording], units: Sequence[str] | None = None) -> Measured:
    """Measure recordings, or what was driven from them.

    Args:
        recordings: at least one.
        units: those of the counts, in this order; by default those of the ``recordings``.
    """
    units = units or units_of(recordings)
    frames = pl.concat([recording.frame() for recording in recordings])
    motion = with_motion(frames)
    samples = samples_of(motion)

    counts = {}
    quantiles = {}
    for name, table in samples.items():
        counts[name] = _histograms(table, units, QUANTITIES[name])
        column = table["value"]
        quantiles[name] = {f"{level:g}": column.quantile(level, "linear") for level in LEVELS}

    # In the order of the units, so that the sum is the same in every run.
    by_unit = motion.filter("counts").group_by("unit", maintain_order=True)
    km = by_unit.agg(km=pl.col("stride").sum() / 1000.0)["km"].to_list()
    changes = samples["lane_change_duration"].height
    return Measured(counts, quantiles, changes, sum(km))


def samples_of(motion: pl.DataFrame) -> dict[str, pl.DataFrame]:
    """The samples of every quantity.

    Args:
        motion: a frame :func:`with_motion`.

    Returns:
        By quantity, a row per sample: columns ``unit`` and ``value``, the latter in the unit of
        :data:`QUANTITIES`.
    """
    # Only rows that are driven and old enough.
    counted = motion.filter("counts")

    # Leaders are looked for among all: one that does not count itself is still followed.
    near = pl.col("counts") & pl.col("gap").is_between(0.0, FOLLOWING_M)
    followers = leader_gaps(motion).filter(near).drop_nulls(["speed", "leader_speed"])
    # Near standstill the headway grows without bound.
    fast_enough = followers.filter(pl.col("speed") >= SLOWEST_FOLLOWER_MPS)
    closing = pl.col("speed") - pl.col("leader_speed")
    approaching = followers.filter(closing > CLOSING_MPS)

    # The spread of a frame stands in the place of the speed; two vehicles have hardly one.
    frames = counted.drop_nulls("speed").group_by("unit", "scene", "frame")
    spreads = frames.agg(pl.col("speed").std(), pl.len())
    crowded = spreads.filter(pl.col("len") >= FEWEST_IN_FRAME)

    # By quantity, the rows that show it, and what it is of their columns.
    values = {
        "speed": (counted, pl.col("speed")),
        "speed_spread": (crowded, pl.col("speed")),
        "acceleration": (counted, pl.col("acceleration")),
        "jerk": (counted, pl.col("jerk")),
        "time_headway": (fast_enough, pl.col("gap") / pl.col("speed")),
        "gap": (followers, pl.col("gap")),
        "time_to_collision": (approaching, pl.col("gap") / closing),
    }
    samples = {}
    for name, (rows, value) in values.items():
        chosen = rows.select("unit", value=value)
        # The ends of a track have no centred differences.
        samples[name] = chosen.drop_nulls().filter(pl.col("value").is_finite())

    # Changes count that cross in a row that counts, censored ones as far as seen: simulations run
    # where and as long as the recordings do, so both are cut off alike.
    widths = dict(motion.select("scene", "lane_width").unique().iter_rows())
    changes = find_lane_changes(tracks_of_frame(motion, widths))
    crossings = motion[changes.sample].with_columns(value=pl.Series(changes.duration_s))
    samples["lane_change_duration"] = crossings.filter("counts").select("unit", "value")
    return samples


def _histograms(table: pl.DataFrame, units: Sequence[str], quantity: Quantity) -> Array:
    """Samples per unit and bin, [units, bins].

    ``table`` has a row per sample, with its ``unit``, one of ``units``, and its ``value``.
    """
    # A row per unit, in their order.
    row = table["unit"].cast(pl.Enum(units)).to_physical().to_numpy()

    # A column per bin; values beyond go into the outermost ones.
    share = (table["value"].to_numpy() - quantity.low) / (quantity.high - quantity.low)
    column = np.clip(np.floor(share * quantity.bins), 0, quantity.bins - 1).astype(np.int64)

    # One after the other, since many samples fall into one bin.
    counts = np.zeros((len(units), quantity.bins))
    np.add.at(counts, (row, column), 1.0)
    return counts


def with_motion(frame: pl.DataFrame) -> pl.DataFrame:
    """``frame`` with what it says of motion, and what counts.

    Returns:
        Further columns: ``speed``, m/s, ``acceleration``, m/s2, and ``jerk``, m/s3, from positions
        one second apart (null at the ends of a track); ``stride``, the step driven, m; ``counts``,
        whether the row is measured.
    """

    def x_at(frames: int) -> pl.Expr:
        """The position ``frames`` later in the same track."""
        return pl.col("x").shift(-frames).over(TRACK)

    # Central differences of positions one second apart, of the first, second and third order.
    way = x_at(_HALF) - x_at(-_HALF)
    bend = x_at(_WHOLE) - 2.0 * pl.col("x") + x_at(-_WHOLE)
    late = _HALF
    later = _HALF + _WHOLE
    swing = x_at(later) - 3.0 * x_at(late) + 3.0 * x_at(-late) - x_at(-later)
    second = _WHOLE * FRAME_S

    # Frames since the vehicle appeared.
    age = pl.col("frame") - pl.col("frame").first().over(TRACK)
    return frame.with_columns(
        speed=way / second,
        acceleration=bend / second**2,
        jerk=swing / second**3,
        stride=pl.col("x") - x_at(-1),
        counts=(age >= round(SETTLING_S / FRAME_S)) & pl.col("driven"),
    )


@dataclass(frozen=True)
class Reference(Measured):
    """Recorded driving as histograms and rates.

    Attributes:
        source: where it was recorded.
        units: names of the scenes.
        whole: lane changes and vehicle-km of all frames, and ``speed_spread_mps``, the spread of
            speeds within a frame, its mean over the frames; long runs are compared with these.
        floors: by driver (``random``, ``constant_velocity``), by quantity: its distance from here.
    """

    source: str
    units: list[str]
    whole: Mapping[str, float]
    floors: Mapping[str, Mapping[str, float]]

    def rate(self) -> dict[str, Any]:
        """Lane changes per vehicle-km of the whole recording, with its exact interval."""
        return lane_change_rate(int(self.whole["lane_changes"]), self.whole["vehicle_km"])

    def save(self, path: Path) -> None:
        """Write as JSON, atomically.

        The ceilings are for who reads the file; :meth:`load` ignores them.
        """
        content = {
            "kind": _KIND,
            "checksum": PLACE,
            "bins": _bins(),
            "ceilings": {name: ceiling(counts) for name, counts in self.counts.items()},
            **vars(self),
            # Arrays are no JSON.
            "counts": {name: counts.astype(int).tolist() for name, counts in self.counts.items()},
        }
        write_json(path, content)

    @classmethod
    def load(cls, path: Path) -> Reference:
        """What :meth:`save` wrote.

        Raises:
            UserError: no such file, a damaged one, another file, or one with other bins.
        """
        try:
            content = read_whole(path)
            whole = has_checksum(content, path)
            numbers = json.loads(content)
            if numbers["kind"] != _KIND:
                raise ValueError("another kind of file")
            if numbers["bins"] != _bins():
                raise ValueError("its histograms have other bins")

            counts = {name: np.array(rows, float) for name, rows in numbers["counts"].items()}
            # Ceilings and checksum follow from the rest.
            values = {part.name: numbers[part.name] for part in fields(cls)}
            reference = cls(**{**values, "counts": counts})
        except (
            OSError,
            ValueError,
            KeyError,
            TypeError,
            AttributeError,
            RecursionError,
        ) as error:
            raise UserError(
                f"{path}: not the histograms of recorded driving that the realism card needs "
                f"({error}); give the recordings with data.path=FILE."
            ) from error

        # Every reference is written with its checksum.
        if not whole:
            refuse_without_checksum(path)
        return reference


def _bins() -> dict[str, list[float]]:
    """Low edge, high edge and number of the bins, by quantity."""
    return {name: [one.low, one.high, one.bins] for name, one in QUANTITIES.items()}
