"""Segments of recorded scenes, and their joint rollouts."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from reference.small_networks import small_generator

from ganlane.data import SyntheticTraffic, synthetic_scenes
from ganlane.generator.forecasts import distance
from ganlane.generator.rollout import rollout, sampled_driver_params, typical_driver_params
from ganlane.generator.segments import cut_segments, extrapolate, scene_tracks
from ganlane.generator.tasks import rollout_errors
from ganlane.parameters.generator import EXTRA_INPUTS, CalibratedConfig

WIDTH = 3.5


@pytest.fixture(scope="module")
def recorded_scenes():
    frame = synthetic_scenes(SyntheticTraffic(scenes=2, vehicles=7, seconds=8.0))
    return [replace(scene, lane_width_m=WIDTH) for scene in scene_tracks(frame)]


@pytest.fixture
def generator():
    return small_generator(EXTRA_INPUTS)


def typical_rollout(generator, segments):
    """Positions when every driver is typical and z = 0."""
    headway, desired = typical_driver_params(segments)
    noise = torch.zeros(1 + segments.future.shape[1], 1, *headway.shape, 4)
    return rollout(generator, segments, headway, desired, noise)[0]


def test_tracks_go_on_at_constant_velocity_beyond_their_ends():
    present = np.array([False, False, True, True, True, False])[:, None]
    positions = np.zeros((6, 1, 2))
    positions[2:5, 0, 0] = [10.0, 11.0, 13.0]
    np.testing.assert_allclose(extrapolate(positions, present)[:, 0, 0], [8, 9, 10, 11, 13, 15])


def test_a_changer_intends_its_new_lane_two_seconds_before_it_is_there(recorded_scenes):
    scene = recorded_scenes[0]
    changers = [v for v in range(scene.lane.shape[1]) if len(set(scene.lane[:, v])) == 2]
    assert changers
    crossed = int((scene.lane[:, changers[0]] != scene.lane[0, changers[0]]).argmax())
    intended = scene.target_lane[:, changers[0]]
    first = int((intended == scene.lane[crossed, changers[0]]).argmax())
    assert first == max(0, crossed - 20)


def test_cut_segments_show_the_recorded_positions(recorded_scenes):
    scenes = cut_segments([(recorded_scenes[0], 3), (recorded_scenes[1], 5)], horizon=6)
    assert scenes.positions.shape == (2, 15, 7, 2)
    recorded = recorded_scenes[1].positions[5:20]
    shown = scenes.positions[1].numpy()
    np.testing.assert_allclose(np.diff(shown, axis=0), np.diff(recorded, axis=0), atol=1e-4)
    np.testing.assert_allclose(shown[..., 1], recorded[..., 1], atol=1e-5)


def test_mirroring_twice_changes_nothing_and_once_swaps_the_lanes(recorded_scenes):
    scenes = cut_segments([(recorded_scenes[0], 0)], horizon=4)
    once = scenes.mirrored()
    torch.testing.assert_close(once.mirrored().positions, scenes.positions, atol=1e-5, rtol=0)
    assert (once.target_lane == 2 - scenes.target_lane).all()
    torch.testing.assert_close(once.positions[..., 1], 2 * WIDTH - scenes.positions[..., 1])


def test_a_rollout_is_the_same_with_more_padding(recorded_scenes, generator):
    segments = cut_segments([(recorded_scenes[0], 0)], horizon=5)
    pad = torch.nn.functional.pad
    wide = replace(
        segments,
        positions=pad(segments.positions, (0, 0, 0, 4)),
        present=pad(segments.present, (0, 4)),
        target_lane=pad(segments.target_lane, (0, 4)),
        length=pad(segments.length, (0, 4), value=1.0),
        width=pad(segments.width, (0, 4), value=1.0),
    )
    torch.testing.assert_close(typical_rollout(generator, wide)[:, :, :7], typical_rollout(generator, segments))


def test_vehicles_that_come_later_start_when_they_appear_and_are_not_scored(recorded_scenes, generator):
    segments = cut_segments([(recorded_scenes[0], 0)], horizon=9)
    segments.present[:, :12, 2] = False
    positions = typical_rollout(generator, segments)
    torch.testing.assert_close(positions[:, :4, 2], segments.future[:, :4, 2])
    assert not torch.allclose(positions[:, 4:, 2], segments.future[:, 4:, 2], atol=1e-5)
    assert not segments.scored[0, :, 2].any()
    # Where it goes later does not matter.
    altered = replace(segments, positions=segments.positions.clone())
    altered.positions[:, 14:, 2] += 5.0
    torch.testing.assert_close(typical_rollout(generator, altered), positions)


def test_gradient_of_a_rollout_is_finite_and_reaches_every_parameter(recorded_scenes, generator):
    segments = cut_segments([(recorded_scenes[0], 0), (recorded_scenes[1], 9)], horizon=6)
    headway, desired = typical_driver_params(segments)
    positions = rollout(generator, segments, headway, desired, torch.randn(7, 3, 2, 7, 4))
    (positions - segments.future).abs()[:, segments.scored].sum().backward()
    for name, parameter in generator.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().sum() > 0, name


def test_nothing_of_the_future_enters_an_evaluation(recorded_scenes, generator):
    segments = cut_segments([(recorded_scenes[0], 0)], horizon=5)
    altered = cut_segments([(recorded_scenes[0], 0)], horizon=5)
    altered.positions[:, 9:] += 7.0
    altered.target_lane[:, 9:] = 0
    one, other = (typical_rollout(generator, each.without_intentions()) for each in (segments, altered))
    torch.testing.assert_close(one, other)


def test_sampled_driver_params_are_above_the_present_speed_and_repeatable(recorded_scenes):
    scenes = cut_segments([(recorded_scenes[0], 0)], horizon=1)
    one = sampled_driver_params(scenes, torch.Generator().manual_seed(4))
    other = sampled_driver_params(scenes, torch.Generator().manual_seed(4))
    assert all((a == b).all() for a, b in zip(one, other))
    speed = (scenes.positions[:, 8] - scenes.positions[:, 7]).norm(dim=-1) * 10
    assert (one[1] > speed + 0.99).all()


def test_constant_velocity_errs_as_worked_by_hand(recorded_scenes):
    scenes = cut_segments([(recorded_scenes[0], 0)], horizon=4)
    step = scenes.positions[0, 8, 3] - scenes.positions[0, 7, 3]
    expected = (scenes.positions[0, 8, 3] + 3 * step - scenes.positions[0, 11, 3]).norm()
    errors = distance(scenes.constant_velocity, scenes.future)
    assert errors[0, 2, 3].item() == pytest.approx(expected.item(), abs=1e-3)


def test_metrics_name_every_scene_and_count_its_vehicles(recorded_scenes, generator):
    metrics = rollout_errors(generator, recorded_scenes, CalibratedConfig(held_out_horizon=9, held_out_stride=20))
    assert set(metrics) == {"all", "synthetic-0", "synthetic-1"}
    assert metrics["all"]["windows"] == metrics["synthetic-0"]["windows"] + metrics["synthetic-1"]["windows"]
    assert metrics["all"]["end_s"] == pytest.approx(0.9)
    assert metrics["all"]["fde_m/mean"] > metrics["all"]["ade_m/mean"]
