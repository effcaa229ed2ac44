"""The generated traffics that ship, with the weights that ship."""

import math
from dataclasses import replace

import pytest
from reference.refusals import user_error
from reference.traffics import assert_close, beyond_the_edge, drive, keep_lane, others_of, overlaps

from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.generator import shipped_generator
from ganlane.native.drivers import SIMULATED_ANCHOR
from ganlane.traffic.presets import gan_calibrated_traffic, gan_traffic, human_traffic
from ganlane.weights import load_weights, save_weights


def test_with_its_guard_gan_traffic_stays_on_the_road_and_without_it_leaves_it():
    guarded, without = (
        others_of(gan_traffic(guard=guard), 16, 40, kernel="auto")[0] for guard in (True, False)
    )
    assert beyond_the_edge(guarded) <= 1e-4
    assert beyond_the_edge(without) > 1.0


@pytest.mark.slow
def test_no_vehicle_leaves_the_road_in_1000_episodes_of_gan_traffic():
    env = HighwayEnv(gan_traffic(), num_envs=250)
    worst = []
    env.recorder = lambda now, running: worst.append(beyond_the_edge(now.columns(slice(1, None))))
    td = env.reset()
    while td[keys.EPISODE].min() < 1000:
        _, td = env.step_and_maybe_reset(td.set(keys.ACTION, keep_lane(td)))
    print(f"the outermost body stayed {-max(worst):.2f} m inside the edge")
    assert max(worst) <= 1e-4


def test_calibrated_traffic_neither_overlaps_nor_leaves_the_road_nor_stands_still():
    others, _ = others_of(gan_calibrated_traffic(), 16, 60, kernel="auto")
    assert overlaps(others) == 0
    assert beyond_the_edge(others) <= 0.0
    assert others.speed[-1].min() > 5.0
    # Recorded drivers differ by 2.8 m/s within a frame; a guard that does the driving leaves 0.1.
    assert others.speed[-1].std(1).mean() > 1.4
    assert others.speed[1:].sum() * 1e-4 > 100  # km


@pytest.mark.slow
def test_calibrated_traffic_changes_lanes_as_often_as_recorded_and_touches_nobody():
    others, _ = others_of(gan_calibrated_traffic(), 96, 200, kernel="auto")
    km = others.speed[1:].sum().item() * 1e-4
    changes = (others.target_lane[1:].diff(dim=0) != 0).sum().item()
    print(f"{changes / km:.2f} changes per vehicle-km in {km:.0f} km, {overlaps(others)} overlaps")
    assert overlaps(others) == 0
    # Recorded: 0.92 per vehicle-km, 95 % interval 0.70 to 1.20.
    assert 0.70 < changes / km < 1.20


@pytest.mark.parametrize("preset", [gan_traffic, gan_calibrated_traffic, human_traffic])
def test_generated_traffic_is_the_same_in_every_batch_up_to_rounding(preset):
    many, alone = (
        drive(HighwayEnv(preset(), len(rows)), rows, 2)[2]["vehicles"] for rows in (range(6), [4])
    )
    assert_close(many[4], alone[0])


def fitted_with(folder, *without, **settings):
    """The shipped calibrated weights as if they had been fitted with other ``settings``.

    ``without`` leaves out.
    """
    tensors, metadata = load_weights(shipped_generator("calibrated"), "generator")
    config = {name: value for name, value in metadata["config"].items() if name not in without}
    path = folder / "generator.safetensors"
    rest = {name: value for name, value in metadata.items() if name not in ("kind", "config")}
    save_weights(path, "generator", tensors, {**rest, "config": {**config, **settings}})
    return path


def anchor_of(path):
    return dict(gan_calibrated_traffic(path=path).named_parts())["generator"].drivers.anchor


@pytest.mark.parametrize(
    "settings",
    [{"washout_s": 6.0, "further_inputs": False}, {"washout_s": math.inf, "further_inputs": True}],
)
def test_calibrated_weights_drive_with_the_washout_and_the_further_inputs_they_were_fitted_with(
    tmp_path, settings
):
    # Everything else is the simulation's own.
    assert anchor_of(fitted_with(tmp_path, **settings)) == replace(SIMULATED_ANCHOR, **settings)


def test_the_shipped_weights_and_older_ones_that_name_no_washout_drive_with_the_default_anchor(
    tmp_path,
):
    older = fitted_with(tmp_path, "washout_s", "further_inputs")
    assert anchor_of(None) == anchor_of(older) == SIMULATED_ANCHOR


@pytest.mark.parametrize(
    "settings",
    [{"washout_s": 0.0}, {"washout_s": math.nan}, {"washout_s": "3"}, {"further_inputs": 1}],
)
def test_weights_of_a_fit_that_this_traffic_cannot_have_are_refused(tmp_path, settings):
    with user_error("fit it again"):
        gan_calibrated_traffic(path=fitted_with(tmp_path, **settings))
