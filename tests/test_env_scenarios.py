"""What drivers do in the scenarios that ship.

Cut-in, stalled car, blocked lane, stop-and-go, dense traffic.
"""

import pytest
import torch
from reference import traffics

import ganlane
from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.sim.scenes import FixedScene, SceneVehicle
from ganlane.sim.state import Road, Vehicles
from ganlane.traffic import IdmTraffic

ROWS = 6


def drive(scene: str | dict, driver: str, traffic: str, seconds: int) -> Vehicles:
    """The start and every physics step [T + 1, N, M] of ``ROWS`` episodes side by side, without a
    goal; nobody is touched.
    """
    env = ganlane.make_env(traffic, ROWS, env=scene, goal_m=1e5).base_env
    policy = ganlane.load_agent(driver, env=scene).policy
    film, _, _ = traffics.drive(env, range(ROWS), seconds, lambda td: policy(td)["action"])
    assert traffics.overlaps(film) == 0
    return film


# Cut-in


@pytest.mark.parametrize(("driver", "traffic"), [("mobil", "idm_mobil"), ("keep_lane", "idm")])
def test_in_the_cut_in_the_ego_brakes_hard_but_nobody_crashes(driver, traffic):
    """IDM wants 1.6 s to the other.

    It starts with 20 m, 3 m/s too fast, and brakes with 5 to 9 m/s2.
    """
    seen = drive("cut_in", driver, traffic, 25)
    assert -10.0 < seen.acceleration.min() < -4.0
    assert (seen.acceleration[:20, :, 0].amin(0) < -4.0).all()


# Stalled car


def test_the_mobil_ego_passes_the_stalled_car_without_a_crash():
    seen = drive("stalled_car", "mobil", "idm_mobil", 60)
    assert (seen.x[-1, :, 0] > 300.0).all()
    assert seen.acceleration.min() > -3.0


def test_the_keep_lane_ego_stops_two_metres_behind_the_stalled_car():
    seen = drive("stalled_car", "keep_lane", "idm", 60)
    gap = seen.x[-1, :, 1] - seen.x[-1, :, 0] - 4.5
    assert ((gap > 1.7) & (gap < 2.6)).all()
    assert (seen.speed[-1, :, 0] < 0.1).all()


# Blocked lane


def test_polite_mobil_strands_at_the_closed_lane_and_egoistic_mobil_finds_a_gap():
    """With politeness 1 a gap of 55 m costs the follower more than the ego gains, until it stands
    and cannot go.
    """
    polite = drive("blocked_lane", "mobil", "idm_mobil", 60)
    assert ((polite.x[-1, :, 0] < 250.0) & (polite.speed[-1, :, 0] < 0.5)).all()
    egoistic = drive("blocked_lane", "mobil_egoistic", "idm_mobil", 60)
    assert (egoistic.x[-1, :, 0] > 320.0).all()


# Stop-and-go


def test_the_wave_travels_backwards_while_everybody_drives_forwards():
    """One wave: cars leave it at its head and join at its tail."""
    scene = {"name": "stop_and_go", "scene": {"waves": 1, "per_wave": 8}}
    seen = drive(scene, "keep_lane", "idm", 24)
    in_the_jam = (seen.speed < 2.0) & (seen.target_lane == 0)
    jam_m = torch.where(in_the_jam, seen.x, 0.0).sum(2) / in_the_jam.sum(2)
    speed = (jam_m[199] - jam_m[79]) / 12.0
    assert ((speed < -1.0) & (speed > -8.0)).all()
    assert (seen.x.diff(dim=0) >= 0.0).all()


def test_the_ego_stops_for_the_wave_and_drives_on_and_the_scene_brakes_gently():
    seen = drive("stop_and_go", "keep_lane", "idm", 60)
    assert (seen.speed[:, :, 0].amin(0) < 3.0).all()
    assert (seen.speed[-1, :, 0] > 5.0).all()
    assert seen.acceleration.min() > -3.0


# Dense traffic


@pytest.mark.slow
def test_the_mobil_ego_gets_through_dense_traffic_and_faster_than_one_that_keeps_its_lane():
    mobil, keeping = (drive("dense", driver, "idm_mobil", 60) for driver in ("mobil", "keep_lane"))
    assert mobil.x[-1, :, 0].mean() > keeping.x[-1, :, 0].mean()


# The seam


def test_any_callable_with_a_check_makes_the_scene():
    class Mine:
        vehicles = 2

        def check(self, road, idm):
            self.checked = road

        def __call__(self, key, dtype):
            rows = (SceneVehicle(0.0, 0, 10.0), SceneVehicle(50.0, 1, 10.0))
            return FixedScene(rows, Road(2))(key, dtype)

    mine = Mine()
    env = HighwayEnv(IdmTraffic(Road(2)), 3, scenes=mine)
    assert mine.checked == Road(2)
    assert env.reset()[keys.VEHICLES, "x"].tolist() == [[0.0, 50.0]] * 3


def test_a_file_gives_vehicles_lanes_and_the_egos_desired_speed(tmp_path):
    path = tmp_path / "mine.csv"
    path.write_text("x_m,lane,speed_mps,desired_speed_mps\n5,1,20,30\n60,2,20,22\n")
    mine = {"env": {"name": "scene", "scene": {"path": path}}}
    env = ganlane.make_env("idm", 2, **mine)
    state = env.reset()[keys.VEHICLES]
    assert state["x"].tolist() == [[0.0, 55.0]] * 2
    assert state["desired_speed"].tolist() == [[30.0, 22.0]] * 2
    assert env.base_env.road == Road(3, 4.0)
    assert ganlane.make_env(**mine, lanes=4).base_env.road.lanes == 4
    slower = ganlane.make_env(**mine, ego_desired_speed_mps=20).reset()[keys.VEHICLES]
    assert slower["desired_speed"][0, 0] == 20.0
