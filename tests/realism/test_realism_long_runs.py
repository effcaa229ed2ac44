"""Long runs without an ego, on traffic of which it is known what they must show."""

import pytest
import torch

from ganlane.realism.long_runs import LongRunParameters, long_run, spawned_vehicles, totals
from ganlane.realism.references import ConstantVelocity, RandomDriving
from ganlane.sim.random import episode_key
from ganlane.sim.state import Road
from ganlane.traffic import IdmTraffic
from ganlane.traffic.presets import gan_calibrated_traffic, gan_traffic

SHORT = LongRunParameters(vehicles=6, vehicle_km=1.0, most_s=20.0)


def start(road, vehicles=9):
    key = episode_key(2, torch.zeros(3, dtype=torch.int64), torch.arange(3))
    return spawned_vehicles(IdmTraffic(road), LongRunParameters(vehicles=vehicles), key)


def test_all_but_the_ego_are_there_and_start_as_the_simulators_episodes_do():
    vehicles = start(Road())
    assert vehicles.x.shape == (3, 10)
    assert not vehicles.valid[:, 0].any()
    assert vehicles.valid[:, 1:].all()
    assert ((vehicles.desired_speed[:, 1:] >= 18.0) & (vehicles.desired_speed[:, 1:] <= 26.0)).all()
    spread = start(Road(), 30).x.amax() - start(Road(), 30).x.amin()
    # 31 places at the paper's density, on 200 m for 9, around the ego's.
    assert 400 < spread < 1378


def test_constant_velocity_keeps_every_speed_and_changes_no_lane():
    run = long_run(ConstantVelocity, Road(), SHORT)
    assert run["vehicle_km"] >= 1.0
    assert run["lane_changes"] == run["off_road"] == run["standstills_in_free_flow"] == 0
    assert run["acceleration_quantiles"]["0.95"] == pytest.approx(0.0, abs=0.01)
    assert run["speeds"]["10 s"]["mean_speed_mps"] == pytest.approx(
        1000 * run["vehicle_km"] / (20 * 6 * run["episodes"]), rel=1e-3
    )
    assert run["speeds"]["60 s"] == {"mean_speed_mps": None, "spread_mps": None, "episodes": 0}
    assert run["guard_share"] is None


def test_blind_driving_overlaps_and_careful_driving_does_not():
    random = long_run(RandomDriving, Road(), LongRunParameters(9, 5.0, 30.0))
    assert random["overlaps"] > 0
    assert random["lane_changes"] > 0
    low, high = random["overlaps_per_1000_vehicle_km_ci"]
    assert low < random["overlaps_per_1000_vehicle_km"] < high
    assert long_run(IdmTraffic, Road(), LongRunParameters(9, 5.0, 30.0))["overlaps"] == 0


def test_the_same_numbers_come_out_again_and_others_of_another_seed():
    runs = [long_run(RandomDriving, Road(), LongRunParameters(6, 1.0, 20.0, seed=seed)) for seed in (0, 0, 1)]
    assert runs[0] == runs[1]
    assert runs[0] != runs[2]


def test_the_share_is_told_for_traffic_with_a_guard_alone():
    short = LongRunParameters(4, 0.1, 10.0)
    assert 0.0 < long_run(gan_traffic, Road(), short)["guard_share"] < 1.0
    assert long_run(lambda road: gan_traffic(road, guard=False), Road(), short)["guard_share"] is None
    assert long_run(gan_calibrated_traffic, Road(), short)["overlaps"] == 0


def test_totals_add_counts_up_and_know_nothing_of_nothing():
    runs = [long_run(RandomDriving, Road(), LongRunParameters(n, 2.0, 20.0)) for n in (5, 9)]
    total = totals(runs)
    km = sum(run["vehicle_km"] for run in runs)
    overlaps = sum(run["overlaps"] for run in runs)
    assert total["overlaps_per_1000_vehicle_km"] == pytest.approx(1000 * overlaps / km)
    assert total["off_road"] == sum(run["off_road"] for run in runs)
    assert totals([])["off_road"] is None
    assert totals([])["lane_changes_per_vehicle_km"] is None
