import json
from dataclasses import asdict
from pathlib import Path

import pytest

from ganlane.data import default_scenes, read_scenes
from ganlane.errors import UserError
from ganlane.generator.checkpoint import load_generator, shipped_generator
from ganlane.generator.fit import split_for_fit
from ganlane.generator.forecasts import BASELINE, paper_forecasts, repeated, scene_metrics
from ganlane.generator.segments import scene_tracks
from ganlane.generator.tasks import rollout_errors
from ganlane.generator.windows import cut_windows, group_windows
from ganlane.parameters.generator import CalibratedConfig, PaperConfig

CONFIGS = {"paper": PaperConfig(), "calibrated": CalibratedConfig()}


@pytest.fixture(scope="module")
def recordings():
    try:
        return read_scenes(default_scenes())
    except UserError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize(
    ("preset", "most"),
    [
        ("paper", {"ade_m/mean": 0.85, "ade_m/single": 0.95, "ade_m/best_of_20": 0.65}),
        ("calibrated", {"ade_m/mean": 0.91, "end_m/mean": 0.75}),
    ],
)
def test_the_shipped_weights_are_of_the_default_settings_and_beat_constant_velocity(preset, most):
    path = shipped_generator(preset)
    _, metadata = load_generator(path, preset)
    assert metadata["config"] == json.loads(json.dumps(asdict(CONFIGS[preset])))
    assert path.stat().st_size < 5_000_000
    assert 0 < metadata["metrics"]["fit"]["seconds"] < 1800
    held_out = metadata["metrics"]["all"]
    for name, share in most.items():
        assert held_out[name] < share * held_out[f"{name.partition('/')[0]}/constant_velocity"], name


def folds_of(preset):
    """Errors pooled over five folds, each forecast by a generator that never saw its scenes."""
    _, metadata = load_generator(shipped_generator(preset), preset)
    return metadata["folds"]


@pytest.mark.parametrize(
    ("preset", "least"),
    [("paper", {"mean": 15, "single": 5, "best_of_20": 35}), ("calibrated", {"mean": 9})],
)
def test_pooled_over_folds_the_errors_stay_under_constant_velocitys(preset, least):
    scores = folds_of(preset)["open_loop"]
    for kind, percent in least.items():
        assert scores["ade_change_percent"][kind] <= -percent, kind
    assert len(scores["folds"]) == 5
    large = [part for part in scores["parts"].values() if part["windows"] >= 500]
    assert large
    assert all(part["ade_change_percent"]["mean"] <= 0 for part in large)
    assert scores["direction_whole_window"]["share_right"]["mean"] >= 0.9


def test_after_five_seconds_the_calibrated_preset_is_at_most_three_quarters_of_constant_velocity_off():
    rollout = folds_of("calibrated")["rollout"]
    assert rollout["tracks"] > 400
    assert rollout["ratio_to_constant_velocity"]["mean"] <= 0.75


@pytest.mark.parametrize("preset", CONFIGS)
def test_the_docs_show_the_figures_that_the_weights_carry(preset):
    page = (Path(__file__).parents[2] / "docs" / "generator_results.md").read_text()
    scores = folds_of(preset)["open_loop"]
    for kind, text in (("mean", "mean prediction"), ("single", "a single sample"), ("best_of_20", "best of 20")):
        row = next(line for line in page.splitlines() if line.startswith(f"| `generator_{preset}`, {text}"))
        figures = (f"{scores['ade_m'][kind]:.3f}", f"{scores['fde_m'][kind]:.3f}")
        assert all(figure in row for figure in (*figures, f"{scores['ade_change_percent'][kind]:+.1f} %"))


@pytest.mark.parametrize("preset", CONFIGS)
def test_the_stated_errors_are_those_of_the_shipped_weights(preset, recordings):
    generator, metadata = load_generator(shipped_generator(preset), preset)
    config = CONFIGS[preset]
    held_out = split_for_fit(scene_tracks(recordings), tuple(metadata["data"]["held_out"])).held_out[:1]
    stated = metadata["metrics"][held_out[0].name]
    if preset == "paper":
        windows = cut_windows(held_out, config.held_out_stride)
        groups = group_windows(windows, config.group_size, config.seed)
        forecasts = paper_forecasts(generator, windows, groups, samples=0)
        forecasts[BASELINE] = repeated(windows.past[:, -1], 8)
        measured, names = scene_metrics(windows, forecasts)["all"], ("fde_m/mean", "ade_m/constant_velocity")
    else:
        measured = rollout_errors(generator, held_out, config)["all"]
        names = ("end_m/mean", "end_m/constant_velocity")
    for name in ("ade_m/mean", "windows", *names):
        assert measured[name] == pytest.approx(stated[name], rel=0.01), name
