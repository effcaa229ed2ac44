"""Spawned scenes, where there are no recordings."""

from ganlane.evaluation.realism.long import LongRunParameters
from ganlane.evaluation.realism.spawned_scenes import spawned_frame
from ganlane.sim.road import Road
from ganlane.traffic import IdmTraffic


def test_spawned_trajectories_are_whole_tracks_in_the_schema():
    frame = spawned_frame(IdmTraffic, Road(), LongRunParameters(5, most_s=10.0), 2)
    assert frame.height == 2 * 5 * 101
    assert frame["unit"].unique().sort().to_list() == ["spawned-0", "spawned-1"]
