"""Exact intervals for rare events: crashes among episodes, and crashes over a distance driven."""

from __future__ import annotations

from scipy.special import betaincinv, gammaincinv

from ganlane.evaluation.statistics import CONFIDENCE, Estimate


def clopper_pearson(count: int, trials: int, confidence: float = CONFIDENCE) -> Estimate:
    """Share ``count / trials`` with its exact binomial interval (Clopper and Pearson 1934).

    Args:
        count: how often it happened, 0 to ``trials``.
        trials: how often it could have happened, at least 1.
        confidence: of the interval; each tail holds at most half of the rest.
    """
    tail = (1.0 - confidence) / 2.0
    low = 0.0 if count == 0 else float(betaincinv(count, trials - count + 1, tail))
    high = 1.0 if count == trials else float(betaincinv(count + 1, trials - count, 1.0 - tail))
    return Estimate(count / trials, low, high)


def poisson_interval(count: int, confidence: float = CONFIDENCE) -> Estimate:
    """Expected number of events behind ``count`` observed ones, with its exact Poisson interval (Garwood 1936)."""
    tail = (1.0 - confidence) / 2.0
    low = 0.0 if count == 0 else float(gammaincinv(count, tail))
    return Estimate(float(count), low, float(gammaincinv(count + 1, 1.0 - tail)))


def rate_per_1000_km(count: int, distance_m: float, confidence: float = CONFIDENCE) -> Estimate | None:
    """Events per 1000 km driven, with the exact Poisson interval; None where no distance was driven."""
    if distance_m <= 0.0:
        return None
    scale = 1e6 / distance_m
    events = poisson_interval(count, confidence)
    low, high = events.low or 0.0, events.high or 0.0
    return Estimate(events.value * scale, low * scale, high * scale)
