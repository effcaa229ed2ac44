"""Rows of the result: medians over the turns of a case, and its ratio to the case that it is held against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from statistics import median

import numpy as np

from ganlane.benchmarks.case import Labels, Row
from ganlane.benchmarks.timing import Sample


def make_row(
    labels: Labels, samples: Sequence[Sample], reference: Sequence[Sample] = (), peak_memory_mb: float | None = None
) -> Row:
    """One row.

    Args:
        labels: of the case.
        samples: of its turns.
        reference: turns of the case that it is held against, taken in turn with them; may be empty.
        peak_memory_mb: if known.

    Returns:
        The labels; ``physics_steps_per_s``, ``decisions_per_s``, ``vehicle_steps_per_s`` (per second of wall time)
        and ``physics_steps_per_cpu_s``; ``wall_s`` and ``cpu_s`` of one turn and the ``decisions`` taken in it by all
        rows of the batch together; ``repetitions`` and ``spread`` (interquartile range of the turns' wall time over
        its median); ``ratio`` and ``ratio_cpu`` (physics steps per second of wall and CPU time over the reference's,
        or None); ``peak_memory_mb``. All are medians over the turns; ratios are medians of the turns' ratios.
    """
    physics = [sample.physics_steps / sample.wall_s for sample in samples]
    return {
        **asdict(labels),
        "physics_steps_per_s": median(physics),
        "decisions_per_s": median(sample.decisions / sample.wall_s for sample in samples),
        "vehicle_steps_per_s": median(physics) * labels.vehicles,
        "physics_steps_per_cpu_s": median(_per_cpu_s(sample) for sample in samples),
        "wall_s": median(sample.wall_s for sample in samples),
        "cpu_s": median(sample.cpu_s for sample in samples),
        "decisions": samples[0].decisions,
        "repetitions": len(samples),
        "spread": spread([sample.wall_s for sample in samples]),
        **_ratios(samples, reference),
        "peak_memory_mb": peak_memory_mb,
    }


def _per_cpu_s(sample: Sample) -> float:
    """Physics steps per CPU second; the CPU clock is coarse on some systems and may not have moved."""
    return sample.physics_steps / max(sample.cpu_s, 1e-6)


def _ratios(samples: Sequence[Sample], reference: Sequence[Sample]) -> Row:
    """Each turn is held against the reference's turn of the same round."""
    if not reference:
        return {"ratio": None, "ratio_cpu": None}
    pairs = list(zip(samples, reference))
    wall = [(one.physics_steps / one.wall_s) / (other.physics_steps / other.wall_s) for one, other in pairs]
    return {"ratio": median(wall), "ratio_cpu": median(_per_cpu_s(one) / _per_cpu_s(other) for one, other in pairs)}


def spread(values: Sequence[float]) -> float:
    """Interquartile range over the median."""
    low, middle, high = np.quantile(np.asarray(values, dtype=np.float64), [0.25, 0.5, 0.75])
    return float((high - low) / middle)


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float | None:
    """``p`` of the least-squares fit ``cost ~ size ** p``; None with fewer than two sizes."""
    if len(set(sizes)) < 2:
        return None
    return float(np.polyfit(np.log(np.asarray(sizes, float)), np.log(np.asarray(costs, float)), 1)[0])
