"""What passes a ramp and a weave at capacity."""

import pytest

from benchmarks.flow import largest_flow, measure, table_of
from ganlane.settings.driving import IdmParameters


def test_the_largest_flow_of_a_platoon_is_that_of_its_headway_at_most():
    """3600 s over the time headway, less what gaps and lengths take."""
    assert 1400 < largest_flow(IdmParameters(), 20.0) < 3600 / 1.6
    assert largest_flow(IdmParameters(), 20.0) < largest_flow(IdmParameters(headway_s=1.0), 20.0)


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["on_ramp", "weave"])
def test_no_queue_locks_up(scene):
    """10,000 vehicles where more arrive than fit; nobody stands for more than three minutes."""
    passed = measure(scene, "idm_mobil", 10_000)
    assert passed.downstream + passed.by_exit >= 10_000
    assert passed.longest_s < 180
    assert 1000 < passed.vph_per_lane < 2400
    assert passed.missed < 0.25 * (passed.by_exit + passed.missed) or scene == "on_ramp"
    assert scene in table_of([passed]).text()
