"""Linear stability of IDM traffic, in plain floats, from the equations: what rings and platoons are
tested against.

Car n follows car n - 1; x along the road, s the gap, v its speed, l its leader's. Near the
equilibrium s_e(v) the acceleration is ``f_s ds + f_v dv + f_l dl``. A wave
``exp(i k n + lambda t)`` obeys, with ``e = exp(-i k)`` (the leader's phase)::

    lambda^2 = f_s (e - 1) + (f_v + f_l e) lambda

For long waves (k -> 0) the real part of lambda is positive, and the traffic string-unstable, where
the slope of the equilibrium speed over the gap, ``-f_s / (f_v + f_l)``, exceeds ``(f_l - f_v) / 2``
(Treiber and Kesting, Traffic Flow Dynamics, 2013, chapter 15).
"""

from __future__ import annotations

import cmath
import math
from typing import NamedTuple

import numpy as np

A, B, HEADWAY, MIN_GAP = 0.7, 1.7, 1.6, 2.0  # Table V
C = 2.0 * math.sqrt(A * B)


class Slopes(NamedTuple):
    """Partial derivatives of IDM's acceleration by gap, own speed and leader's speed."""

    gap: float
    speed: float
    leader: float


def equilibrium(speed: float, desired: float) -> float:
    """s_e(v), m."""
    return (MIN_GAP + speed * HEADWAY) / math.sqrt(1.0 - (speed / desired) ** 4)


def slopes(speed: float, desired: float) -> Slopes:
    """At the equilibrium: of ``a (1 - (v/v0)^4 - (s*/s)^2)``, ``s* = d0 + v T + v (v - l) / c``."""
    wanted = MIN_GAP + speed * HEADWAY
    gap = equilibrium(speed, desired)
    pull = 2.0 * A * wanted / gap**2
    by_speed = -4.0 * A * speed**3 / desired**4 - pull * (HEADWAY + speed / C)
    return Slopes(pull * wanted / gap, by_speed, pull * speed / C)


def instability(speed: float, desired: float) -> float:
    """Above 0 where long waves grow."""
    f = slopes(speed, desired)
    return -f.gap / (f.speed + f.leader) - 0.5 * (f.leader - f.speed)


def critical_speed(desired: float) -> float:
    """m/s; string-unstable below (down to a crawl), stable above."""
    low, high = 0.5 * desired, 0.99 * desired
    assert instability(low, desired) > 0.0 > instability(high, desired)
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if instability(middle, desired) > 0.0 else (low, middle)
    return low


def step_matrix(speed: float, desired: float, ahead: np.ndarray, dt: float) -> np.ndarray:
    """One step of (displacements, speeds): ``v' = v + a dt``, ``x' = x + (v + v') dt / 2``.

    ``ahead`` gives each of them its leader: a permutation of the cars on a ring, the phase ``e`` of
    a wave.
    """
    f = slopes(speed, desired)
    one = np.eye(len(ahead))
    by_x = f.gap * (ahead - one)
    by_v = f.speed * one + f.leader * ahead
    return np.block(
        [[one + 0.5 * dt**2 * by_x, dt * one + 0.5 * dt**2 * by_v], [dt * by_x, one + dt * by_v]]
    )


def wave(speed: float, desired: float, k: float, dt: float) -> tuple[complex, complex]:
    """Factor z per step of the slowest-decaying wave, and speed over displacement (1/s) in it."""
    phase = np.array([[cmath.exp(-1j * k)]])
    factors, shapes = np.linalg.eig(step_matrix(speed, desired, phase, dt))
    slowest = np.abs(factors).argmax()
    displacement, its_speed = shapes[:, slowest]
    return complex(factors[slowest]), complex(its_speed / displacement)


def growth_rate(speed: float, desired: float, cars: int, dt: float) -> tuple[float, int]:
    """Of the fastest wave that fits on a ring of ``cars``: rate in 1/s, and how often it fits."""
    rates = [
        (math.log(abs(wave(speed, desired, 2.0 * math.pi * j / cars, dt)[0])) / dt, j)
        for j in range(1, cars // 2)
    ]
    return max(rates)
