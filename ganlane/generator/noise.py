"""The latent vector over time: each driver's own, wandering slowly, always standard normal."""

from __future__ import annotations

import math

from torch import Tensor

from ganlane.keys import PHYSICS_STEP_S


def wander(noise: Tensor, fresh: Tensor, period_s: float) -> Tensor:
    """``noise`` 0.1 s later: an Ornstein-Uhlenbeck process with unit variance that forgets within ``period_s``.

    ``fresh`` are independent standard normal numbers of the same shape. A period of 0 draws anew at every step.
    """
    kept = math.exp(-PHYSICS_STEP_S / period_s) if period_s > 0 else 0.0
    return kept * noise + math.sqrt(1.0 - kept * kept) * fresh
