"""Observations on scenes made by hand: Table III entry by entry, the lane view, the fixed order, lengths."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from reference.worlds import vehicles
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from ganlane.config.env import EnvConfig
from ganlane.env import HighwayEnv
from ganlane.errors import UserError
from ganlane.parameters.observation import largest_number
from ganlane.sim import Road
from ganlane.traffic import IdmMobilTraffic
from ganlane.transforms import (
    OBSERVATIONS,
    ObservationTransform,
    RewardTransform,
    SensorParameters,
    observation_size,
)
from ganlane.transforms.observation import Measurement, measure

EGO = (0.0, 1, 20.0, 25.0)
EMPTY = [1.0, 0.0, 0.0]
LORRY = {"length": 12.0}


def scene(rows, valid=None):
    """One environment from (x, lane, speed, desired speed, 25 m/s if left out) per vehicle, the ego first."""
    names = ("x", "lane", "speed", "desired_speed")
    return vehicles(*({**dict(zip(names, row)), "valid": valid is None or valid[i]} for i, row in enumerate(rows)))


def observe(form, rows, valid=None, lanes=3, progress=0.0, direction=0, sideways=0.0):
    transform = ObservationTransform(Road(lanes), len(rows), form)
    ones = torch.ones(1, dtype=torch.float64)
    cars = scene(rows, valid)
    cars = cars.with_(y=cars.y + sideways)
    return transform.observe(cars, progress * ones, torch.tensor([direction]), transform.road)[0]


def test_the_ego_reports_its_speed_over_its_desired_speed_and_the_lanes_beside_it():
    middle = observe("table3", [EGO, (50.0, 1, 20.0, 20.0)])
    assert middle[:3].tolist() == [0.8, 1.0, 1.0]
    leftmost = observe("table3", [(0.0, 2, 20.0, 25.0), (50.0, 1, 20.0, 20.0)])
    assert leftmost[1:3].tolist() == [0.0, 1.0]
    rightmost = observe("table3", [(0.0, 0, 20.0, 25.0), (50.0, 1, 20.0, 20.0)])
    assert rightmost[1:3].tolist() == [1.0, 0.0]


def test_its_own_speed_ratio_is_not_clipped():
    assert observe("table3", [(0.0, 1, 30.0, 25.0), (50.0, 1, 20.0, 20.0)])[0] == pytest.approx(1.2)


def test_another_vehicle_gives_position_over_200_m_speed_over_30_and_half_a_unit_per_lane():
    values = observe("table3", [EGO, (50.0, 2, 26.0, 20.0)])
    assert values[3:].tolist() == pytest.approx([0.25, 0.2, 0.5])
    values = observe("table3", [(0.0, 2, 20.0, 25.0), (-20.0, 0, 14.0, 20.0)])
    assert values[3:].tolist() == pytest.approx([-0.1, -0.2, -1.0])


def test_the_others_come_nearest_first_whatever_their_index():
    values = observe("table3", [EGO, (90.0, 1, 20.0, 20.0), (-30.0, 1, 20.0, 20.0), (60.0, 1, 20.0, 20.0)])
    assert values[3::3].tolist() == pytest.approx([-0.15, 0.3, 0.45])


def test_far_vehicles_are_clipped_to_one():
    values = observe("table3", [EGO, (900.0, 1, 60.0, 20.0), (-900.0, 1, 0.0, 20.0)])
    assert values[3::3].tolist() == [1.0, -1.0]
    assert values[4].item() == 1.0


def test_a_vehicle_that_is_not_valid_reads_far_ahead_and_comes_last():
    rows = [EGO, (10.0, 1, 26.0, 20.0), (50.0, 1, 26.0, 20.0)]
    values = observe("table3", rows, valid=[True, False, True])
    assert values[3:].tolist() == pytest.approx([0.25, 0.2, 0.0, 1.0, 0.0, 0.0])


def test_on_a_road_of_one_lane_the_lane_difference_is_zero():
    values = observe("table3", [(0.0, 0, 20.0, 25.0), (50.0, 0, 20.0, 20.0)], lanes=1)
    assert values[1:3].tolist() == [0.0, 0.0]
    assert values[5].item() == 0.0


def test_progress_adds_the_egos_own_lane_change():
    values = observe("table3_progress", [EGO, (50.0, 1, 20.0, 20.0)], progress=0.25, direction=-1)
    assert values[-2:].tolist() == [0.25, -1.0]


def test_the_lane_view_holds_the_nearest_ahead_and_behind_in_three_lanes():
    rows = [EGO, (50.0, 2, 26.0, 20.0), (90.0, 2, 20.0, 20.0), (-34.5, 1, 14.0, 20.0)]
    view = observe("lane_view", rows)[3:-2].reshape(6, 3)
    nothing = [1.0, 0.0, 0.0]
    gap = 45.5
    assert view[0].tolist() == pytest.approx([gap / 200, torch.exp(torch.tensor(-gap / 15.0)).item(), 0.2])
    assert view[3].tolist() == pytest.approx([30.0 / 200, torch.exp(torch.tensor(-2.0)).item(), -0.2])
    for index in (1, 2, 4, 5):
        assert view[index].tolist() == nothing


def test_a_lane_change_shows_in_the_drift_before_its_middle():
    rows = [EGO, (50.0, 2, 26.0, 20.0), (-34.5, 1, 14.0, 20.0)]
    sideways = torch.tensor([[0.0, -1.2, 0.5]])
    view = observe("lane_view_drift", rows, sideways=sideways)[3:-2].reshape(6, 4)
    assert view[:, 3].tolist() == pytest.approx([-0.6, 0.0, 0.0, 0.25, 0.0, 0.0])
    assert torch.equal(view[:, :3].flatten(), observe("lane_view", rows)[3:-2])


@pytest.mark.parametrize(("ahead_m", "gap_m"), [(0.0, -4.5), (1.5, -3.0), (4.5, 0.0), (30.0, 25.5)])
@pytest.mark.parametrize("way", [1, -1])
def test_gaps_below_zero_tell_how_far_beside_somebody_is(ahead_m, gap_m, way):
    rows = [EGO, (way * ahead_m, 2, 26.0, 20.0)]
    row = 0 if way * ahead_m > 0 else 1
    view = observe("lane_view_overlap", rows)[3:-2].reshape(6, 4)
    assert view[row, 0].item() == pytest.approx(gap_m / 200)
    nearness = 1 - gap_m if gap_m <= 0 else torch.exp(torch.tensor(-gap_m / 15)).item()
    assert view[row, 1].item() == pytest.approx(nearness)
    assert view[1 - row].tolist() == [1.0, 0.0, 0.0, 0.0]
    flat = observe("lane_view_drift", rows)[3:-2].reshape(6, 4)
    assert flat[row, 0].item() == pytest.approx(max(gap_m, 0.0) / 200)


@pytest.mark.parametrize("form", list(OBSERVATIONS))
def test_every_form_has_the_size_it_says_and_a_spec_that_holds(form):
    base = HighwayEnv(IdmMobilTraffic(), num_envs=3)
    env = TransformedEnv(base, Compose(ObservationTransform(base.road, 9, form), RewardTransform()))
    assert env.reset()["observation"].shape == (3, observation_size(form, 9))
    check_env_specs(env, seed=0)


def test_the_papers_form_has_27_numbers_for_nine_vehicles():
    assert observation_size("table3", 9) == 27


def test_an_unknown_form_is_refused_with_the_known_ones():
    with pytest.raises(UserError, match="table3_progress"):
        ObservationTransform(Road(), 9, "pixels")


@pytest.mark.parametrize("form", list(OBSERVATIONS))
def test_no_number_but_the_first_exceeds_the_largest_of_its_form(form):
    beside = [EGO, (0.0, 2, 26.0, 20.0), (0.5, 0, 26.0, 20.0), (-30.0, 1, 14.0, 20.0)]
    values = observe(form, beside)
    assert values[1:].max() <= largest_number(form)
    assert values[1:].min() >= -1.0
    assert largest_number(form) == (5.5 if form == "lane_view_overlap" else 1.0)


# Lengths


def view_of(*others: dict, ego_length: float = 4.5, form: str = "lane_view_drift") -> torch.Tensor:
    """Left, own, right x ahead, behind: (gap in m, nearness, relative speed, drift), of an ego in the middle lane."""
    scene = vehicles({"x": 0.0, "lane": 1, "length": ego_length}, *others)
    nothing = torch.zeros(1, dtype=torch.float64)
    observation = ObservationTransform(Road(3), len(others) + 1, form).observe(
        scene, nothing, nothing.long(), Road(3)
    )
    view = observation[0, 3:-2].reshape(6, 4)
    return view * view.new_tensor([200.0, 1.0, 1.0, 1.0])


@pytest.mark.parametrize(("row", "x_m", "lane"), [(0, 30.0, 2), (3, -30.0, 1), (4, 30.0, 0), (5, -30.0, 0)])
def test_the_gap_to_a_lorry_is_bumper_to_bumper_ahead_and_behind(row, x_m, lane):
    """Centres 30 m apart; 2.25 m of the car and 6 m of the lorry lie between them, so 21.75 m are free."""
    view = view_of({"x": x_m, "lane": lane, **LORRY})
    assert view[row, 0].item() == pytest.approx(21.75)
    assert view[row, 1].item() == pytest.approx(np.exp(-21.75 / 15.0))


def test_an_ego_that_is_a_lorry_has_its_own_length_too():
    """Two lorries: 6 m of either; a lorry and a car: 6 m and 2.25 m."""
    view = view_of({"x": 30.0, "lane": 1, **LORRY}, {"x": -30.0, "lane": 2}, ego_length=12.0)
    assert view[2, 0].item() == pytest.approx(18.0)
    assert view[1, 0].item() == pytest.approx(21.75)


def test_of_the_nearest_its_own_length_is_taken_and_nobody_elses():
    ahead = [{"x": 20.0, "lane": 1}, {"x": 40.0, "lane": 1, **LORRY}, {"x": 10.0, "lane": 2, **LORRY}]
    view = view_of(*ahead)
    assert view[2, 0].item() == pytest.approx(15.5)
    assert view[0, 0].item() == pytest.approx(1.75)


@pytest.mark.parametrize(("x_m", "overlap_m"), [(0.0, 8.25), (-5.0, 3.25), (-8.25, 0.0)])
def test_beside_a_lorry_the_overlap_is_as_long_as_the_two_bodies(x_m, overlap_m):
    view = view_of({"x": x_m, "lane": 2, **LORRY}, form="lane_view_overlap")
    assert view[1, 0].item() == pytest.approx(-overlap_m)
    assert view[1, 1].item() == pytest.approx(1.0 + overlap_m)
    assert view_of({"x": x_m, "lane": 2, **LORRY})[1, 0].item() == 0.0


def test_lengths_are_known_without_error_whatever_the_sensors_measure():
    scene = vehicles({"x": 0.0, "lane": 1}, {"x": 30.0, "lane": 2, **LORRY}, {"x": -50.0, "lane": 1})
    errors = SensorParameters(position_noise_m=2.0, speed_noise_mps=1.0)
    seen: Measurement = measure(scene, torch.tensor([5]), torch.tensor([0]), errors)
    assert seen.x[0, 1] != 30.0
    nothing = torch.zeros(1, dtype=torch.float64)
    transform = ObservationTransform(Road(3), 3, "lane_view_overlap")
    observation = transform.observe(scene, nothing, nothing.long(), Road(3), scene.with_(**seen._asdict()))
    gaps = 200.0 * observation[0, 3:-2].reshape(6, 4)[:, 0]
    assert gaps[0].item() == pytest.approx(seen.x[0, 1].item() - 8.25)
    assert gaps[3].item() == pytest.approx(-seen.x[0, 2].item() - 4.5)


def test_the_largest_number_grows_with_the_longest_vehicle_where_overlap_counts():
    assert largest_number("lane_view_overlap") == 5.5
    assert largest_number("lane_view_overlap", 12.0) == 13.0
    assert largest_number("lane_view_drift", 12.0) == 1.0
    beside = view_of({"x": 0.0, "lane": 2, **LORRY}, form="lane_view_overlap", ego_length=12.0)
    assert beside[:, 1].max().item() == largest_number("lane_view_overlap", 12.0)


@pytest.mark.parametrize(("share", "largest"), [(0.0, 5.5), (0.5, 13.0)])
def test_the_bounds_of_the_gymnasium_space_know_of_lorries(share, largest):
    space = gymnasium.make("ganlane/Highway-v0", env=EnvConfig(truck_share=share)).observation_space
    assert space.high[1:].tolist() == [largest] * (space.shape[0] - 1)
