"""Box overlap against the corners of the scalar simulator, and cases by hand."""

import math

import pytest
import torch
from reference import scalar
from reference.worlds import drawing, scalar_cars, vehicles, vehicles_at

from ganlane.sim.collisions import dangerously_close, ego_overlaps, pair_overlaps


def test_overlap_agrees_with_the_corners_of_the_scalar_simulator():
    between = drawing((2000, 2), 11)
    pairs = vehicles_at(
        between(-3, 3),
        torch.zeros(2000, 2, dtype=torch.int64),
        y=between(-3, 3),
        heading=between(-math.pi, math.pi),
        length=between(3.0, 6.0),
        width=between(1.6, 2.6),
    )
    expected = [scalar.overlap(*scalar_cars(pairs, row)) for row in range(2000)]
    assert pair_overlaps(pairs)[:, 0, 1].tolist() == expected


@pytest.mark.parametrize(
    ("x", "y", "heading", "hit"),
    [
        (4.5, 0.0, 0.0, False),  # bumper to bumper is no crash
        (4.49, 0.0, 0.0, True),
        (0.0, 2.5, 0.0, False),
        (0.0, 2.49, 0.0, True),
        (3.5, 0.0, math.pi / 2, False),  # crosswise: (4.5 + 2.5) / 2
        (3.49, 0.0, math.pi / 2, True),
        # Turned by 45 degrees its corner reaches (4.5 + 2.5) / 2 / sqrt(2) = 2.4749 m: 4.7249 in
        # all.
        (4.73, -1.0, math.pi / 4, False),
        (4.70, 0.7071, math.pi / 4, True),
    ],
)
def test_overlap_by_hand(x, y, heading, hit):
    scene = vehicles({"x": 0.0}, {"x": x, "y": y, "heading": heading})
    assert ego_overlaps(scene).tolist() == [[hit]]
    assert pair_overlaps(scene).tolist() == [[[False, hit], [hit, False]]]


def test_an_invalid_vehicle_hits_nobody():
    scene = vehicles({"x": 0.0}, {"x": 1.0, "valid": False}, {"x": 2.0})
    assert ego_overlaps(scene).tolist() == [[False, True]]
    assert pair_overlaps(scene)[0].nonzero().tolist() == [[0, 2], [2, 0]]


@pytest.mark.parametrize(
    ("gap", "closing", "close"),
    [
        (1.99, -5.0, True),  # under 2 m, whatever the speeds
        (2.0, 0.0, False),
        (14.9, 10.0, True),  # 1.49 s
        (15.0, 10.0, False),
        (3.0, -10.0, False),
        (10_000.0, 0.0, False),
    ],
)
def test_a_soft_crash_is_a_gap_under_2_m_or_under_1_5_s(gap, closing, close):
    assert dangerously_close(torch.tensor(gap), torch.tensor(closing)).item() is close
