import json
from dataclasses import asdict

import pytest

from ganlane.data import default_scenes, read_scenes, scene_lane_widths
from ganlane.errors import UserError
from ganlane.generator.calibrated import CalibratedConfig
from ganlane.generator.checkpoint import load_generator, shipped_generator
from ganlane.generator.fitting import PaperConfig
from ganlane.generator.groups import group_windows
from ganlane.generator.metrics import open_loop
from ganlane.generator.rollout_metrics import rollout_metrics
from ganlane.generator.stretches import SceneSource
from ganlane.generator.tracks import scene_tracks, split_scenes
from ganlane.generator.windows import cut_windows

CONFIGS = {"paper": PaperConfig(), "calibrated": CalibratedConfig()}


@pytest.fixture(scope="module")
def recordings():
    try:
        return read_scenes(default_scenes())
    except UserError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("preset", CONFIGS)
def test_the_shipped_weights_are_small_and_come_from_the_default_settings(preset):
    path = shipped_generator(preset)
    _, metadata = load_generator(path, preset)
    assert metadata["config"] == json.loads(json.dumps(asdict(CONFIGS[preset])))
    assert path.stat().st_size < 5_000_000


def test_the_paper_preset_beats_constant_velocity_on_scenes_it_was_not_fitted_to():
    _, metadata = load_generator(shipped_generator("paper"))
    held_out = metadata["metrics"]["all"]
    assert held_out["ade_m/mean"] < 0.85 * held_out["ade_m/constant_velocity"]
    assert held_out["ade_m/single"] < 0.95 * held_out["ade_m/constant_velocity"]
    assert held_out["ade_m/best_of_20"] < 0.65 * held_out["ade_m/constant_velocity"]


def test_the_calibrated_preset_beats_constant_velocity_on_scenes_it_was_not_fitted_to():
    _, metadata = load_generator(shipped_generator("calibrated"))
    held_out = metadata["metrics"]["all"]
    assert held_out["ade_m/mean"] < 0.91 * held_out["ade_m/constant_velocity"]
    assert held_out["end_m/mean"] < 0.75 * held_out["end_m/constant_velocity"]


def test_the_stated_errors_of_the_paper_preset_are_those_of_the_shipped_weights(recordings):
    generator, metadata = load_generator(shipped_generator("paper"), "paper")
    config = PaperConfig()
    _, held_out = split_scenes(scene_tracks(recordings), tuple(metadata["data"]["held_out"]))
    groups = group_windows(cut_windows(held_out, config.held_out_stride), config.group_size, config.seed)
    measured = open_loop(generator, groups, tuple(scene.name for scene in held_out), config.seed)["all"]
    stated = metadata["metrics"]["all"]
    for name in ("ade_m/mean", "fde_m/mean", "ade_m/constant_velocity", "windows"):
        assert measured[name] == pytest.approx(stated[name], rel=0.01), name


def test_the_stated_errors_of_the_calibrated_preset_are_those_of_the_shipped_weights(recordings):
    generator, metadata = load_generator(shipped_generator("calibrated"), "calibrated")
    config, widths = CalibratedConfig(), scene_lane_widths(recordings)
    _, held_out = split_scenes(scene_tracks(recordings), tuple(metadata["data"]["held_out"]))
    sources = [SceneSource.of(scene, widths[scene.name]) for scene in held_out]
    measured = rollout_metrics(
        generator, sources, config.held_out_horizon, config.held_out_stride, config.noise_period_s
    )["all"]
    for name in ("ade_m/mean", "end_m/mean", "end_m/constant_velocity", "windows"):
        assert measured[name] == pytest.approx(metadata["metrics"]["all"][name], rel=0.01), name
