"""The sheet of recorded driving has the data, with their names and units."""

from __future__ import annotations

from reference.synthetic import SyntheticTraffic, synthetic_scenes
from view_scenes import panels, words

from ganlane.data import PooledStatistics, Scene
from ganlane.view.recordings import draw_recordings


def measured(**traffic):
    statistics = PooledStatistics()
    for (name,), scene in synthetic_scenes(SyntheticTraffic(**traffic)).group_by("scene"):
        statistics.add(Scene(name, scene, 3.5))
    return statistics


def test_recordings_are_drawn_in_six_panels_with_their_units():
    drawn = panels(draw_recordings(measured(lanes=1, seconds=3.0)))
    times = (
        "time to change lanes",
        "followers' headway: median (gap - 2 m) / speed",
        "time headway: gap / speed",
    )
    units = {
        "speed": "m/s",
        "acceleration": "m/s²",
        **dict.fromkeys(times, "s"),
        "gap to the leader": "m",
    }
    assert {title: axes.get_xlabel() for title, axes in drawn.items()} == units
    assert words(drawn.pop("time to change lanes").texts) == ["none recorded from start to end"]
    assert all(line.get_ydata().sum() > 0 for axes in drawn.values() for line in axes.lines)
    assert words(drawn["acceleration"].get_legend().get_texts()) == ["as recorded", "over 1 s"]
