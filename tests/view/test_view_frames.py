"""Frames show what the trajectory says, where it says it."""

import timeit
from dataclasses import replace

import numpy as np
import pytest
from view_scenes import area, near, place, straight

from ganlane import keys
from ganlane.settings.render import FilmConfig
from ganlane.settings.road import EXIT, WALL, LaneStretch
from ganlane.view import EpisodeLabel, FramePainter, canvas
from ganlane.view.canvas import HEADER_HEIGHT, Window


def road_of(picture):
    """The picture below the header."""
    return picture[HEADER_HEIGHT:]


def bare(scene, frame=0):
    """The road in a frame without trails and speeds."""
    look = FilmConfig(trail_s=0.0, speeds=False)
    return road_of(FramePainter(scene, look).draw(frame))


def test_the_ego_stays_at_its_column_and_others_stand_at_their_distance():
    tint = canvas.speed_tint(20.0)
    scene = straight([0, 40], [1, 2], frames=50)
    for frame in (0, 17, 49):
        picture = bare(scene, frame)
        ego, other = place(picture, canvas.EGO), place(picture, tint)
        assert ego[0] == pytest.approx(0.38 * 1280, abs=2)
        assert other[0] - ego[0] == pytest.approx(40 * 1280 / 160, abs=2)
        # One lane further left is further up, by the exaggerated width of a lane.
        assert ego[1] - other[1] == pytest.approx(4.0 * 1.5 * 1280 / 160, abs=2)


def test_every_end_is_written_on_the_last_frame_only_and_a_crash_has_a_ring():
    cut_off = FramePainter(straight([0], [1]))
    ended = {end: FramePainter(straight([0], [1], outcome=end)) for end in keys.END_EVENTS}
    last = {painter.draw(19).tobytes() for painter in (cut_off, *ended.values())}
    assert len(last) == 1 + len(keys.END_EVENTS)
    before = {painter.draw(18).tobytes() for painter in ended.values()}
    assert before == {cut_off.draw(18).tobytes()}
    assert area(road_of(ended["hard_crash"].draw(19))[60:], canvas.CRASH) > 500


def test_lights_show_braking_and_the_lane_to_be_entered():
    calm = straight([0], [1])
    braking = replace(calm, acceleration=calm.acceleration - 3.0)
    signalling = replace(calm, target_lane=calm.target_lane + 1)
    assert area(bare(calm), canvas.BRAKE) == 0
    assert area(bare(braking), canvas.BRAKE) > 5
    lit = bare(signalling)
    assert area(lit, canvas.AMBER, 12) > 5
    assert place(lit, canvas.AMBER, 12)[1] < place(lit, canvas.EGO)[1]
    # Indicators blink: dark half a second later.
    assert area(bare(signalling, 5), canvas.AMBER, 12) == 0


@pytest.mark.slow
def test_nine_vehicles_are_drawn_fast_enough_for_60_frames_a_second():
    generator = np.random.default_rng(0)
    scene = straight(generator.uniform(-60, 90, 9), generator.integers(0, 3, 9), frames=60)
    painter = FramePainter(scene)
    painter.draw(0)
    rounds_s = timeit.repeat(lambda: [painter.draw(frame) for frame in range(30)], number=1)
    # The fastest round: other work on the machine is no fault of the drawing.
    assert 30 / min(rounds_s) > 60


# Where lanes begin and end


def two_lanes(stretch):
    """The picture of an ego in the left one, its window, and the row of the right one's middle."""
    label = EpisodeLabel(lanes=2, stretches=(stretch, LaneStretch()))
    window = Window(FilmConfig(), 2, 4.0)
    picture = FramePainter(straight([0.0], [1], label=label)).draw(0)
    return picture, window, int(window.row(0.0))


@pytest.mark.parametrize(
    ("stretch", "road"),
    [
        (LaneStretch(end_m=20.0, end=WALL), [True, True, False]),
        (LaneStretch(-20.0, 20.0, EXIT), [False, True, True]),
        (LaneStretch(-20.0, 20.0, WALL), [True, True, False]),
        (LaneStretch(), [True, True, True]),
    ],
)
def test_there_is_asphalt_where_the_lane_is_and_a_ramp_before_or_behind_it(stretch, road):
    """In the middle of the right lane, 30 m behind the ego, beside it, and 30 m ahead of it."""
    picture, window, row = two_lanes(stretch)
    columns = window.column([-30.0, 0.0, 30.0], 0.0).astype(int).tolist()
    assert near(picture, canvas.ASPHALT)[row, columns].tolist() == road


def test_a_wall_is_red():
    picture, window, row = two_lanes(LaneStretch(end_m=20.0, end=WALL))
    place_of_wall = place(picture, canvas.CRASH)
    assert place_of_wall[0] == pytest.approx(window.column(20.5, 0.0), abs=2.0)
    assert place_of_wall[1] == pytest.approx(row, abs=4.0)
