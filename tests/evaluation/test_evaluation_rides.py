"""What a crash hit."""

import pytest
from reference.worlds import vehicles

from ganlane.evaluation.rides import SIDES, contact_side
from ganlane.sim.state import Road


@pytest.mark.parametrize(
    ("other", "side"),
    [
        ({"x": 4.4, "speed": 10.0}, "ahead"),
        ({"x": -4.4, "speed": 30.0}, "behind"),
        ({"y": 2.4, "heading": -0.1}, "side"),
        ({"x": 4.0, "y": 2.2, "heading": -0.1}, "side"),
        ({"x": -4.2, "y": 1.0, "speed": 30.0, "heading": 0.1}, "behind"),
        ({"x": 10.0}, "none"),
    ],
)
def test_where_the_ego_was_hit(other, side):
    scene = vehicles({"x": 0.0, "y": 0.0, "target_lane": 0}, {"x": 0.0, "y": 0.0, "target_lane": 0, **other})
    assert SIDES[int(contact_side(scene, Road()))] == side
