"""Who is ahead on the same episodes, held against SciPy and hand-worked differences."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from scipy import stats

from ganlane.evaluation import paired_rows, paired_table
from ganlane.evaluation.paired import verdict
from ganlane.evaluation.statistics import Estimate


def driven(agent, rewards, traffic="gan", first=0):
    """The columns that a comparison reads, one row per episode."""
    n = len(rewards)
    return pl.DataFrame(
        {
            "agent": [agent] * n,
            "traffic": [traffic] * n,
            "seed": [3] * n,
            "episode": range(first, first + n),
            "reward": [float(reward) for reward in rewards],
        }
    )


@pytest.fixture
def rewards():
    """Two drivers whose returns share most of their spread."""
    generator = np.random.default_rng(2)
    common = generator.normal(200.0, 80.0, 120)
    return common + generator.normal(6.0, 15.0, 120), common


def test_the_lead_is_the_mean_difference_with_scipys_interval(rewards):
    (row,) = paired_rows(pl.concat([driven("trained", rewards[0]), driven("mobil", rewards[1])]))
    difference = rewards[0] - rewards[1]
    expected = stats.bootstrap((difference,), np.mean, n_resamples=10_000, method="BCa", random_state=1)
    low, high = expected.confidence_interval
    assert (row["agent"], row["over"], row["traffic"], row["episodes"]) == ("trained", "mobil", "gan", 120)
    assert row["lead"] == pytest.approx(difference.mean())
    assert row["lead_ci"] == pytest.approx([low, high], abs=0.05 * (high - low))
    assert row["verdict"] == "above"


def test_the_first_driver_is_held_against_every_other_on_every_traffic():
    episodes = [
        driven(agent, [base, base + 1.0], traffic)
        for traffic in ("idm", "gan")
        for agent, base in (("trained", 5.0), ("mobil", 7.0), ("keep_lane", 1.0))
    ]
    rows = paired_rows(pl.concat(episodes))
    assert [(row["traffic"], row["over"], row["lead"], row["verdict"]) for row in rows] == [
        ("idm", "mobil", -2.0, "below"),
        ("idm", "keep_lane", 4.0, "above"),
        ("gan", "mobil", -2.0, "below"),
        ("gan", "keep_lane", 4.0, "above"),
    ]


def test_only_episodes_that_both_drove_count_in_whatever_order():
    # Shared are the episodes 2, 3 and 4: differences of 2, 4 and 6.
    other = driven("mobil", [10.0, 20.0, 30.0, 99.0], first=2).reverse()
    (row,) = paired_rows(pl.concat([driven("a", [-50.0, -60.0, 12.0, 24.0, 36.0]), other]))
    assert (row["episodes"], row["lead"]) == (3, pytest.approx(4.0))


def test_a_single_driver_and_a_single_episode_give_no_pairs():
    assert paired_rows(driven("a", [1.0, 2.0])) == []
    assert paired_rows(pl.concat([driven("a", [1.0]), driven("b", [2.0])])) == []


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [(0.1, 3.0, "above"), (-3.0, -0.1, "below"), (-1.0, 3.0, "undecided"), (0.0, 3.0, "undecided")],
)
def test_a_verdict_needs_an_interval_on_one_side_of_zero(low, high, said):
    assert verdict(Estimate((low + high) / 2.0, low, high)) == said


def test_the_table_gives_the_sign_the_interval_and_the_verdict():
    row = {"agent": "trained", "over": "mobil", "traffic": "gan", "episodes": 300}
    above = {**row, "lead": 12.34, "lead_ci": [4.51, 20.1], "verdict": "above"}
    below = {**row, "over": "agent_idm", "lead": -3.0, "lead_ci": [-5.0, -1.0], "verdict": "below"}
    heading, _, first, second = paired_table([above, below]).splitlines()
    assert heading.split() == ["paired", "lead", "traffic", "reward", "[95", "%]", "verdict"]
    assert "trained over mobil " in first
    assert "+12.3 [4.5, 20.1]" in first
    assert first.endswith("above")
    assert "-3.0 [-5.0, -1.0]" in second
    assert second.endswith("below")
