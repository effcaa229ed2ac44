"""Everybody's length counts in the lane view, and for 4.5 m nothing has changed, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference.worlds import vehicles

from ganlane.api import make_env
from ganlane.config.env import EnvConfig
from ganlane.gym.rows import Rows
from ganlane.sim import Road, Vehicles
from ganlane.transforms import ObservationTransform, SensorParameters, largest_number
from ganlane.transforms.observation import ObservationScale, Others, lane_offset, lane_view, other_vehicles
from ganlane.transforms.sensors import Measurement, measure

LORRY = {"length": 12.0}
SCALE = ObservationScale()


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


def view_of_cars_alone(others: Others, lanes: int, drift: bool, overlap: bool) -> torch.Tensor:
    """The lane view as it was when every vehicle was taken to be 4.5 m long: the formula that agents learnt from."""
    side, way = (
        others.position.new_tensor(each)[:, None]
        for each in ((1.0, 1.0, 0.0, 0.0, -1.0, -1.0), (1.0, -1.0, 1.0, -1.0, 1.0, -1.0))
    )
    distance = others.position[:, None, :] * way
    in_sight = (others.valid & (others.position.abs() < 1.0))[:, None, :]
    there = (distance > 0) | ((distance == 0) & (way < 0))
    counts = in_sight & there & (lane_offset(others, lanes)[:, None, :] == side)
    distance = torch.add(distance, ~counts, alpha=1e9)
    nearest = distance.amin(-1, keepdim=True)
    farther, found = distance > nearest, nearest <= 1.0

    def of_the_nearest(field: torch.Tensor) -> torch.Tensor:
        value = torch.add(field[:, None, :], farther, alpha=1e9).amin(-1, keepdim=True)
        return torch.where(found, value, 0.0)

    gap_m = (nearest * SCALE.range_m - 4.5).clamp_min(-4.5 if overlap else 0.0)
    gap = torch.where(found, gap_m / SCALE.range_m, 1.0)
    overlap_m = (-gap_m).clamp_min(0.0)
    nearness = torch.where(found, torch.exp(-gap_m.clamp_min(0.0) / 15.0) + overlap_m / 1.0, 0.0)
    seen = (gap, nearness, of_the_nearest(others.speed), *((of_the_nearest(others.drift),) if drift else ()))
    return torch.cat(seen, dim=-1).flatten(1)


def random_scenes(dtype: torch.dtype, rows: int = 4000, count: int = 9) -> Vehicles:
    """Cars of 4.5 m anywhere within and beyond sight, many of them side by side; some are not there."""
    random = torch.Generator().manual_seed(3)

    def draw() -> torch.Tensor:
        return torch.rand(rows, count, generator=random, dtype=dtype)

    near = draw() < 0.4
    x = torch.where(near, 30.0 * (draw() - 0.5), 500.0 * (draw() - 0.5))
    x = torch.where(draw() < 0.1, x.round(), x)  # so that some are equally far
    x[:, 0] = 1000.0 * draw()[:, 0] * (draw()[:, 0] < 0.5)
    lane = (3.0 * draw()).floor()
    zero = torch.zeros_like(x)
    length = zero + 4.5
    y = 4.0 * lane + 1.9 * (2.0 * draw() - 1.0)
    there = draw() < 0.9
    x[:, 1:] = x[:, 1:] + x[:, :1]
    return Vehicles(
        x, y, zero, 30.0 * draw(), zero, length, zero + 2.5, zero + 25.0, lane.long(), lane.long() * 0, there
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("drift", "overlap"), [(False, False), (True, False), (True, True), (False, True)])
def test_for_cars_of_4_5_m_the_lane_view_is_bit_for_bit_what_it_was(dtype, drift, overlap):
    others = other_vehicles(random_scenes(dtype), Road(3), SCALE)
    now = lane_view(others, 3, SCALE, drift, overlap)
    before = view_of_cars_alone(others, 3, drift, overlap)
    assert torch.equal(now.view(torch.uint8), before.view(torch.uint8))
    if overlap:
        assert (now < 0).any()


def test_the_largest_number_grows_with_the_longest_vehicle_where_overlap_counts():
    assert largest_number("lane_view_overlap") == 5.5
    assert largest_number("lane_view_overlap", 12.0) == 13.0
    assert largest_number("lane_view_drift", 12.0) == 1.0
    beside = view_of({"x": 0.0, "lane": 2, **LORRY}, form="lane_view_overlap", ego_length=12.0)
    assert beside[:, 1].max().item() == largest_number("lane_view_overlap", 12.0)


@pytest.mark.parametrize(("share", "largest"), [(0.0, 5.5), (0.5, 13.0)])
def test_the_bounds_of_the_gymnasium_space_know_of_lorries(share, largest):
    env = make_env("idm", env=EnvConfig(truck_share=share), observation="lane_view_overlap")
    assert Rows(env).space.high[1:].tolist() == [largest] * (Rows(env).space.shape[0] - 1)
