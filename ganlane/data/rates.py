"""How often lanes are changed: equation 9, the rate per driven kilometre, and equation 10's ``t_m``."""

from __future__ import annotations

from scipy.special import gammaincinv  # scipy.stats takes seconds to import

from ganlane.data.schema import FRAME_S


def srlc(changes: int, vehicles: int, road_m: float) -> float:
    """Equation 9: lane changes per vehicle and kilometre of road, ``n / q * 1000 / L``.

    It takes every vehicle to have driven the whole road; where tracks cover only part of it, it is too low.

    Args:
        changes: ``n``, lane changes seen.
        vehicles: ``q``, vehicles seen.
        road_m: ``L``, length of the road, m.
    """
    return changes / vehicles * 1000.0 / road_m


def poisson_interval(count: int, level: float = 0.95) -> tuple[float, float]:
    """Exact interval of a Poisson mean of which ``count`` events were seen (Garwood 1936)."""
    tail = 0.5 * (1.0 - level)
    low = gammaincinv(count, tail) if count else 0.0
    return float(low), float(gammaincinv(count + 1, 1.0 - tail))


def steps_between_changes(rate_per_km: float, speed_mps: float, step_s: float = FRAME_S) -> float:
    """Equation 10's ``t_m``: mean time between two lane changes of a vehicle, in steps of ``step_s``.

    Args:
        rate_per_km: lane changes per vehicle-kilometre, above 0.
        speed_mps: mean speed, m/s.
    """
    return 1000.0 / (rate_per_km * speed_mps * step_s)
