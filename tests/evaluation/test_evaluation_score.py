"""The score where there is little to go by."""

from __future__ import annotations

import math
import warnings

import pytest

from ganlane.evaluation import normalized_percent


def test_resamples_without_a_lead_do_not_spoil_the_interval():
    """In one of the four episodes MOBIL leads by nothing; a resample of that one alone has no scale."""
    mobil, random_legal, agent = [10.0, 20.0, 30.0, 40.0], [10.0, 0.0, 0.0, 0.0], [10.0, 10.0, 15.0, 20.0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        score = normalized_percent(agent, mobil, random_legal, resamples=4000)
    assert score.percent == pytest.approx(100.0 * 45.0 / 90.0)
    assert score.interval is not None
    # In the other episodes the agent is half way from random to MOBIL, and where all are equal it changes nothing.
    assert score.interval == pytest.approx([50.0, 50.0])
    assert all(map(math.isfinite, score.interval))
