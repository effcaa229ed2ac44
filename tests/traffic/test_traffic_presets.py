"""The generated traffics that ship, with the weights that ship."""

import math
from dataclasses import replace

import pytest
import torch

from ganlane.data import DrivingStatistics
from ganlane.env import HighwayEnv
from ganlane.errors import UserError
from ganlane.generator import shipped_generator
from ganlane.sim import Road, Vehicles, pair_overlaps
from ganlane.sim.state import lateral_half_extent
from ganlane.traffic import Guard
from ganlane.traffic.presets import SIMULATED_ANCHOR, gan_calibrated_traffic, gan_traffic, sudden_accelerations
from ganlane.weights import load_weights, save_weights


def drive(traffic, n, decisions, visit, first_episode=0):
    """The state after so many decisions of a keep-lane ego; ``ended`` says whose episode was over by then."""
    env = HighwayEnv(traffic, num_envs=n, first_episode=first_episode)
    env.recorder = visit
    state, ended = env.reset(), torch.zeros(n, 1, dtype=torch.bool)
    for _ in range(decisions):
        state["action"] = torch.zeros(n, dtype=torch.int64)
        state = env.step(state)["next"]
        ended = ended | state["done"]
        if bool(ended.all()):
            break
    return state.set("ended", ended)


def beyond_the_edge(vehicles: Vehicles, road: Road) -> float:
    """How far the outermost body reaches past the edge of the road, m; negative inside."""
    half = lateral_half_extent(vehicles)
    left = vehicles.y + half - road.left_edge_m()
    right = road.right_edge_m() - (vehicles.y - half)
    return float(torch.maximum(left, right)[:, 1:].max())


def test_with_its_guard_gan_traffic_stays_on_the_road_and_without_it_leaves_it():
    road, worst = Road(), {True: -9.0, False: -9.0}
    for guard in worst:

        def visit(vehicles, running, guard=guard):
            worst[guard] = max(worst[guard], beyond_the_edge(vehicles, road))

        drive(gan_traffic(road, guard=guard), 16, 40, visit)
    assert worst[True] <= 1e-4
    assert worst[False] > 1.0


@pytest.mark.slow
def test_no_vehicle_leaves_the_road_in_1000_episodes_of_gan_traffic():
    road, worst, ended = Road(), [-9.0], 0

    def visit(vehicles, running):
        worst[0] = max(worst[0], beyond_the_edge(vehicles, road))

    for chunk in range(4):
        state = drive(gan_traffic(road), 250, 1000, visit, first_episode=250 * chunk)
        ended += int(state["ended"].sum())
    print(f"{ended} episodes to their end; the outermost body stayed {-worst[0]:.2f} m inside the edge")
    assert ended == 1000
    assert worst[0] <= 1e-4


def test_calibrated_traffic_neither_overlaps_nor_leaves_the_road_nor_stands_still():
    road, worst, overlaps, km = Road(), [-9.0], [0], [0.0]

    def visit(vehicles, running):
        worst[0] = max(worst[0], beyond_the_edge(vehicles, road))
        overlaps[0] += int(pair_overlaps(vehicles)[:, 1:, 1:].sum())
        km[0] += float(vehicles.speed[:, 1:].sum()) * 1e-4

    state = drive(gan_calibrated_traffic(road), 16, 60, visit)
    assert overlaps[0] == 0
    assert worst[0] <= 0.0
    speed = state["vehicles", "speed"][:, 1:]
    assert speed.min() > 5.0
    # Recorded drivers differ by 2.8 m/s within a frame; a guard that does the driving leaves 0.1.
    assert speed.std(1).mean() > 1.4
    assert km[0] > 100


@pytest.mark.slow
def test_calibrated_traffic_changes_lanes_as_often_as_recorded_and_touches_nobody():
    count, km, overlaps, before = [0], [0.0], [0], {}

    def visit(vehicles, running):
        if before:
            count[0] += int((vehicles.target_lane != before["lane"])[:, 1:].sum())
        before["lane"] = vehicles.target_lane
        km[0] += float(vehicles.speed[:, 1:].sum()) * 1e-4
        overlaps[0] += int(pair_overlaps(vehicles)[:, 1:, 1:].sum())

    drive(gan_calibrated_traffic(), 96, 200, visit)
    print(f"{count[0] / km[0]:.2f} changes per vehicle-km in {km[0]:.0f} vehicle-km, {overlaps[0]} overlaps")
    assert overlaps[0] == 0
    # Recorded: 0.92 per vehicle-km, 95 % interval 0.70 to 1.20.
    assert 0.70 < count[0] / km[0] < 1.20


def test_calibrated_drivers_keep_different_headways_and_their_own():
    traffic = gan_calibrated_traffic()
    env = HighwayEnv(traffic, num_envs=64)
    state = env.reset()
    headway = state["traffic", "generator", "headway"]
    assert headway.std() > 0.3
    state["action"] = torch.zeros(64, dtype=torch.int64)
    assert torch.equal(env.step(state)["next", "traffic", "generator", "headway"], headway)


def test_generated_traffic_is_the_same_in_every_batch_up_to_rounding():
    for preset in (gan_traffic, gan_calibrated_traffic):
        many = drive(preset(), 6, 5, None)
        alone = drive(preset(), 1, 5, None, first_episode=4)
        for name in ("x", "y", "speed"):
            torch.testing.assert_close(many["vehicles", name][4], alone["vehicles", name][0], atol=2e-3, rtol=1e-4)


def test_the_paper_chain_has_a_guard_that_can_be_left_out():
    assert isinstance(dict(gan_traffic().named_parts())["guard"], Guard)
    assert "guard" not in dict(gan_traffic(guard=False).named_parts())


def test_weights_of_the_other_preset_are_refused():
    with pytest.raises(UserError, match="paper"):
        gan_traffic(path=shipped_generator("calibrated"))
    with pytest.raises(UserError, match="no such file"):
        gan_calibrated_traffic(path="nowhere.safetensors")


def fitted_with(folder, *without, **settings):
    """The shipped calibrated weights as if they had been fitted with other ``settings``; ``without`` leaves out."""
    tensors, metadata = load_weights(shipped_generator("calibrated"), "generator")
    config = {name: value for name, value in metadata["config"].items() if name not in without}
    path = folder / "generator.safetensors"
    rest = {name: value for name, value in metadata.items() if name not in ("kind", "config")}
    save_weights(path, "generator", tensors, {**rest, "config": {**config, **settings}})
    return path


def anchor_of(traffic):
    return dict(traffic.named_parts())["generator"].anchor


def test_calibrated_weights_drive_with_the_washout_and_the_further_inputs_they_were_fitted_with(tmp_path):
    for settings in ({"washout_s": 6.0, "further_inputs": False}, {"washout_s": math.inf, "further_inputs": True}):
        anchor = anchor_of(gan_calibrated_traffic(path=fitted_with(tmp_path, **settings)))
        assert {name: getattr(anchor, name) for name in settings} == settings
        # Everything else is the simulation's own.
        assert (anchor.idm, anchor.lane_stiffness) == (SIMULATED_ANCHOR.idm, SIMULATED_ANCHOR.lane_stiffness)


def test_the_shipped_weights_and_older_ones_that_name_no_washout_drive_with_the_default_anchor(tmp_path):
    older = fitted_with(tmp_path, "washout_s", "further_inputs", "traits")
    for path in (None, older):
        assert anchor_of(gan_calibrated_traffic(path=path)) == SIMULATED_ANCHOR


def test_weights_that_see_no_further_inputs_drive_otherwise_than_those_that_do(tmp_path):
    blind = gan_calibrated_traffic(path=fitted_with(tmp_path, further_inputs=False), noise_scale=0.0)
    seeing = gan_calibrated_traffic(noise_scale=0.0)
    ends = [drive(traffic, 4, 3, None)["vehicles", "speed"][:, 1:] for traffic in (blind, seeing)]
    assert float((ends[0] - ends[1]).abs().max()) > 1e-3


def test_calibrated_weights_fitted_without_traits_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"generator\.safetensors: fitted with traits=False"):
        gan_calibrated_traffic(path=fitted_with(tmp_path, traits=False))


@pytest.mark.parametrize(
    "settings", [{"washout_s": 0.0}, {"washout_s": math.nan}, {"washout_s": "3"}, {"further_inputs": 1}]
)
def test_a_washout_or_further_inputs_that_no_fit_can_have_are_refused(tmp_path, settings):
    with pytest.raises(UserError, match="fit it again"):
        gan_calibrated_traffic(path=fitted_with(tmp_path, **settings))


@pytest.mark.parametrize(
    ("recorded", "driven"), [((0.0, 0.0), (0.0, 0.0)), ((0.3, 0.5), (0.3, 0.5)), ((None, None), (0.0, 0.8))]
)
def test_recorded_accelerations_of_zero_are_not_missing_ones(recorded, driven):
    _, metadata = load_weights(shipped_generator("paper"), "generator")
    statistics = DrivingStatistics.from_dict(metadata["driving_statistics"])
    smoothed = replace(statistics.acceleration_smoothed, mean=recorded[0], sd=recorded[1])
    sudden = sudden_accelerations(replace(statistics, acceleration_smoothed=smoothed))
    assert (sudden.mean, sudden.sd) == driven
