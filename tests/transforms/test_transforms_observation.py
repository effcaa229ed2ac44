"""Observations on scenes made by hand.

Table III entry by entry, the lane view, the fixed order, lengths.
"""

import gymnasium
import numpy as np
import pytest
import torch
from reference.refusals import user_error
from reference.worlds import DOUBLE, vehicles
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from ganlane.env import HighwayEnv
from ganlane.settings.env import EnvConfig
from ganlane.settings.observation import largest_number
from ganlane.settings.road import EXIT, WALL, LaneStretch
from ganlane.sim import Road
from ganlane.traffic import IdmMobilTraffic
from ganlane.transforms import OBSERVATIONS, ObservationTransform, RewardTransform, observation_size

ROAD = Road(3)
EGO = (0.0, 1, 20.0)
NOBODY = [1.0, 0.0, 0.0]


def observed(scene, form, road=ROAD, progress=0.0, direction=0):
    """The observation [D] of a scene of one row."""
    transform = ObservationTransform(road, scene.x.shape[1], form)
    progress = torch.tensor([progress], dtype=DOUBLE)
    return transform.observe(scene, progress, torch.tensor([direction]), road, scene)[0]


def scene_of(*rows):
    """(x, lane, speed) of every vehicle, the ego first; all would like 25 m/s."""
    return vehicles(*(dict(zip(("x", "lane", "speed"), row)) for row in rows))


def neighbours_in(values, numbers=4):
    """Of a lane view: left, own, right x ahead, behind, so many numbers each."""
    return values[3:-2].reshape(6, numbers)


@pytest.mark.parametrize(
    ("lanes", "rows", "expected"),
    [
        # The ego's speed over its desired speed, not clipped, and the lanes beside it. Then another
        # vehicle: position over 200 m, speed over 30 m/s, half a unit per lane.
        (3, [EGO, (50.0, 2, 26.0)], [0.8, 1.0, 1.0, 0.25, 0.2, 0.5]),
        (3, [(0.0, 2, 20.0), (-20.0, 0, 14.0)], [0.8, 0.0, 1.0, -0.1, -0.2, -1.0]),
        (3, [(0.0, 0, 30.0), (50.0, 1, 30.0)], [1.2, 1.0, 0.0, 0.25, 0.0, 0.5]),
        # The nearest first, whatever their index; far ones are clipped to one.
        (
            3,
            [EGO, (90.0, 1, 20.0), (-30.0, 1, 20.0), (900.0, 1, 60.0), (-901.0, 1, 0.0)],
            [0.8, 1.0, 1.0, -0.15, 0.0, 0.0, 0.45, 0.0, 0.0, 1.0, 1.0, 0.0, -1.0, -2 / 3, 0.0],
        ),
        # One lane has none beside the ego, and no lane difference.
        (1, [(0.0, 0, 20.0), (50.0, 0, 20.0)], [0.8, 0.0, 0.0, 0.25, 0.0, 0.0]),
    ],
)
def test_table_3(lanes, rows, expected):
    assert observed(scene_of(*rows), "table3", Road(lanes)).tolist() == pytest.approx(expected)


def test_in_table_3_one_that_is_not_valid_reads_far_ahead_and_comes_last():
    scene = scene_of(EGO, (10.0, 1, 26.0), (50.0, 1, 26.0))
    scene.valid[0, 1] = False
    expected = [0.25, 0.2, 0.0, *NOBODY]
    assert observed(scene, "table3")[3:].tolist() == pytest.approx(expected)


def test_progress_adds_the_egos_own_lane_change():
    scene = scene_of(EGO, (50.0, 1, 20.0))
    values = observed(scene, "table3_progress", progress=0.25, direction=-1)
    assert values[-2:].tolist() == [0.25, -1.0]


def test_the_lane_view_holds_the_nearest_ahead_and_behind_in_three_lanes():
    """Bumper to bumper: half of the car, and half of the lorry that leads or follows."""
    scene = scene_of(EGO, (50.0, 2, 26.0), (90.0, 2, 20.0), (-34.5, 1, 14.0))
    scene.length[0, [1, 3]] = 12.0
    view = neighbours_in(observed(scene, "lane_view"), 3)
    for row, gap, faster in ((0, 41.75, 0.2), (3, 26.25, -0.2)):
        assert view[row].tolist() == pytest.approx([gap / 200, np.exp(-gap / 15.0), faster])
    assert view[[1, 2, 4, 5]].tolist() == [NOBODY] * 4


def test_a_lane_change_shows_in_the_drift_before_its_middle():
    scene = scene_of(EGO, (50.0, 2, 26.0), (-34.5, 1, 14.0))
    moved = scene.with_(y=scene.y + torch.tensor([[0.0, -1.2, 0.5]]))
    view = neighbours_in(observed(moved, "lane_view_drift"))
    assert view[:, 3].tolist() == pytest.approx([-0.6, 0.0, 0.0, 0.25, 0.0, 0.0])
    assert torch.equal(view[:, :3], neighbours_in(observed(scene, "lane_view"), 3))


@pytest.mark.parametrize(("ahead_m", "gap_m"), [(0.0, -4.5), (1.5, -3.0), (4.5, 0.0), (30.0, 25.5)])
@pytest.mark.parametrize("way", [1, -1])
def test_gaps_below_zero_tell_how_far_beside_somebody_is(ahead_m, gap_m, way):
    scene = scene_of(EGO, (way * ahead_m, 2, 26.0))
    row = 0 if way * ahead_m > 0 else 1
    view = neighbours_in(observed(scene, "lane_view_overlap"))
    assert view[row, 0].item() == pytest.approx(gap_m / 200)
    assert view[row, 1].item() == pytest.approx(1 - gap_m if gap_m <= 0 else np.exp(-gap_m / 15))
    assert view[1 - row].tolist() == [*NOBODY, 0.0]
    flat = neighbours_in(observed(scene, "lane_view_drift"))
    assert flat[row, 0].item() == pytest.approx(max(gap_m, 0.0) / 200)


@pytest.mark.parametrize("form", list(OBSERVATIONS))
def test_every_form_has_the_size_it_says_and_a_spec_that_holds(form):
    base = HighwayEnv(IdmMobilTraffic(), num_envs=3)
    env = TransformedEnv(base, Compose(ObservationTransform(base.road, 9, form), RewardTransform()))
    assert env.reset()["observation"].shape == (3, observation_size(form, 9))
    assert observation_size("table3", 9) == 27  # the paper's
    check_env_specs(env, seed=0)


def test_an_unknown_form_is_refused_with_the_known_ones():
    with user_error("table3_progress"):
        ObservationTransform(Road(), 9, "pixels")


@pytest.mark.parametrize("form", list(OBSERVATIONS))
@pytest.mark.parametrize("length_m", [4.5, 12.0])
def test_no_number_but_the_first_exceeds_the_largest_of_its_form(form, length_m):
    size = {"length": length_m}
    beside = [{"x": x, "lane": lane, **size} for x, lane in ((0.0, 2), (0.5, 0), (-30.0, 1))]
    values = observed(vehicles({"x": 0.0, "lane": 1, **size}, *beside), form)[1:]
    largest = largest_number(form, length_m)
    assert -1.0 <= values.min() <= values.max() <= largest
    if form in ("lane_view_overlap", "road_view"):  # bodies that overlap whole
        assert values.max() == largest == 1.0 + length_m
    else:
        assert largest == 1.0


@pytest.mark.parametrize(("share", "largest"), [(0.0, 5.5), (0.5, 13.0)])
def test_the_bounds_of_the_gymnasium_space_know_of_lorries(share, largest):
    space = gymnasium.make("ganlane/Highway-v0", env=EnvConfig(truck_share=share)).observation_space
    assert space.high[1:].tolist() == [largest] * (space.shape[0] - 1)


# Where lanes begin and end


def road_numbers(x, lane, *stretches):
    """The last 8 numbers of ``road_view``, of an ego with its front at ``x``."""
    road = Road(len(stretches), stretches=stretches)
    return observed(scene_of((x - 2.25, lane), (-900.0, 0)), "road_view", road)[-8:].tolist()


def test_the_road_view_tells_how_far_the_lanes_go_on_and_when_they_begin():
    wall = LaneStretch(200.0, 600.0, WALL)
    assert road_numbers(100.0, 1, wall, LaneStretch()) == pytest.approx(
        [0.0, 1.0, 0.5, 1.0, 0.0, 0.1, 0.0, 1.0]
    )
    assert road_numbers(500.0, 0, wall, LaneStretch()) == pytest.approx(
        [1.0, 0.1, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0]
    )


def test_the_road_view_tells_which_lane_to_reach_and_by_when():
    leaving = LaneStretch(200.0, 600.0, EXIT)
    numbers = road_numbers(100.0, 2, leaving, LaneStretch(), LaneStretch())
    assert numbers[-2:] == pytest.approx([-1.0, 0.5])
    numbers = road_numbers(350.0, 0, leaving, LaneStretch(), LaneStretch())
    assert numbers[-2:] == pytest.approx([0.0, 0.25])
