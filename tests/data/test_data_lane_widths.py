"""Lane widths estimated from positions and lane numbers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ganlane.data.lane_widths import lane_width


@given(width=st.floats(3.0, 4.0), seed=st.integers(0, 10_000))
def test_lane_keepers_tell_the_width_to_a_few_centimetres(width, seed):
    random = np.random.default_rng(seed)
    lane = random.permutation(np.arange(400) % 4)
    y = lane * width + random.normal(0.0, 0.2, lane.size)
    nearest = np.rint(y / width).astype(np.int64)
    assert lane_width(y, nearest) == pytest.approx(width, abs=0.06)


def test_vehicles_on_the_boundary_tell_the_width_where_lane_keepers_sit_off_centre():
    width = 3.5
    # All keep half a metre to the left but in lane 0, so the spacing of the medians says 3.75 m; some cross over.
    keepers = np.concatenate((np.full(50, 0.0), np.full(50, 4.0), np.full(50, 7.5)))
    crossing = np.linspace(0.0, 7.0, 71)
    y = np.concatenate((keepers, crossing))
    assert lane_width(y, np.rint(y / width).astype(np.int64)) == pytest.approx(width, abs=0.03)


def test_a_single_lane_gets_the_standard_width():
    assert lane_width(np.linspace(-0.3, 0.3, 20), np.zeros(20, np.int64)) == 3.66


def test_one_stray_row_does_not_make_a_lane():
    y = np.concatenate((np.zeros(50), np.full(50, 3.5), [30.0]))
    lane = np.concatenate((np.zeros(50), np.ones(50), [5])).astype(np.int64)
    assert lane_width(y, lane) == pytest.approx(3.5)
