"""Tables of driven episodes, made by hand, for what is computed from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import polars as pl

#: Length of every episode, km.
KM = 5.0


def driven(
    agent: str,
    rewards: Sequence[float],
    reasons: Sequence[str] | None = None,
    traffic: str = "idm",
    at_fault: bool | None = None,
    **columns: Any,
) -> pl.DataFrame:
    """Episodes with these rewards and ends; ``columns`` take the place of others.

    Every hard crash is one with somebody who cuts in.
    """
    reasons = reasons or ["goal"] * len(rewards)
    crashed = [reason == "hard_crash" for reason in reasons]
    values = {
        "agent": agent,
        "traffic": traffic,
        "seed": 7,
        "episode": range(len(rewards)),
        "reason": reasons,
        "reward": list(map(float, rewards)),
        "distance_m": 1000.0 * KM,
        "duration_s": 200.0,
        "lane_changes": 10,
        "soft_crash": [0] * len(rewards),
        "had_soft_crash": False,
        "soft_crash_behind": 1,
        "at_fault": [at_fault if crash else None for crash in crashed],
        "crash": ["cut_in" if crash else None for crash in crashed],
        "least_ttc_s": 3.0,
        "least_headway_s": 1.0,
        "rms_acceleration_mps2": 0.5,
        "hardest_braking_mps2": -2.0,
    }
    types = {"at_fault": pl.Boolean, "crash": pl.String}
    return pl.DataFrame({**values, **columns}, schema_overrides=types)
