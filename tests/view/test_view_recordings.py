"""The sheet of figures: densities hold all of their samples, and the picture can be drawn of any recording."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ganlane.data import Bins, Histogram, PooledStatistics, Scene, SyntheticTraffic, synthetic_scenes
from ganlane.view import draw_recordings
from ganlane.view.recordings import density_line


@given(st.lists(st.floats(0.0, 9.99), min_size=1, max_size=200), st.sampled_from([10, 80, 400, 8000]))
def test_the_area_below_a_density_is_one(values, bins):
    histogram = Histogram(Bins(0.0, 10.0, bins))
    histogram.add(values)
    line = density_line(histogram, 0.0, 10.0)
    assert float(np.sum(line.y)) * float(line.x[1] - line.x[0]) == pytest.approx(1.0)
    assert line.x[0] > 0.0
    assert line.x[-1] < 10.0


@pytest.mark.parametrize("lanes", [1, 3])
def test_a_sheet_is_drawn_with_and_without_lane_changes(lanes):
    frame = synthetic_scenes(SyntheticTraffic(scenes=1, lanes=lanes, seconds=3.0))
    statistics = PooledStatistics()
    statistics.add(Scene("synthetic-0", frame, 3.5))
    sheet = draw_recordings(statistics)
    assert sheet.size == (1440, 540)
    blue = np.all(np.asarray(sheet) == (0, 114, 178), axis=2)
    panels = [blue[270 * row :, 480 * column :][:270, :480] for row in (0, 1) for column in range(3)]
    assert all(panel.sum() > 5 for panel in panels)
