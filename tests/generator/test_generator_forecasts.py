import numpy as np
import pytest
import torch

from ganlane.data import SyntheticTraffic, synthetic_scenes
from ganlane.generator.closed_loop import EXTRA_INPUTS
from ganlane.generator.fit_calibrated import CalibratedConfig
from ganlane.generator.forecasts import (
    by_kind,
    calibrated_forecasts,
    driven_windows,
    idm_forecasts,
    paper_forecasts,
)
from ganlane.generator.groups import group_windows
from ganlane.generator.networks import Generator, GeneratorSizes
from ganlane.generator.scores import displacement_errors, errors_of, window_errors
from ganlane.generator.segments import segment_sources
from ganlane.generator.windows import cut_windows, scene_tracks

SMALL = {"embedding": 16, "hidden": 12, "pooling": 10, "pooled": 6, "context": 14, "noise": 4}
STRIDE = 7


@pytest.fixture(scope="module")
def scenes():
    """Two scenes; in the first a vehicle leaves early and another comes late."""
    every = scene_tracks(synthetic_scenes(SyntheticTraffic(scenes=2, vehicles=7, seconds=6.0)))
    every[0].present[25:, 1] = False
    every[0].present[:12, 3] = False
    return every


@pytest.fixture(scope="module")
def sources(scenes):
    return segment_sources(scenes, {scene.name: 3.5 for scene in scenes})


def small_generator(extra_inputs: int) -> Generator:
    torch.manual_seed(1)
    return Generator(GeneratorSizes(**SMALL, extra_inputs=extra_inputs))


@pytest.mark.parametrize("horizon", [8, 20])
def test_driven_windows_are_the_cut_windows_in_the_same_order(scenes, sources, horizon):
    windows = cut_windows(scenes, STRIDE, 9 + horizon)
    recorded = driven_windows(lambda stretch: stretch.future[None], sources, horizon, STRIDE)[0]
    np.testing.assert_allclose(recorded, windows.future, atol=1e-4)


def test_the_best_of_the_samples_is_the_nearest_on_average():
    recorded = np.zeros((2, 3, 2))
    samples = np.zeros((22, 2, 3, 2))
    samples[1:, ..., 0] = 5.0
    samples[4, 0], samples[9, 1] = 1.0, 2.0
    found = by_kind(samples, recorded)
    np.testing.assert_array_equal(found["best_of_20"], np.stack([samples[4, 0], samples[9, 1]]))
    assert by_kind(samples[:1], recorded).keys() == {"mean"}
    assert by_kind(samples[:2], recorded).keys() == {"mean", "single"}


def test_forecasts_of_the_papers_preset_score_as_the_groups_do(scenes):
    generator, windows = small_generator(0), cut_windows(scenes, STRIDE)
    forecasts = paper_forecasts(generator, windows, 4)
    row = displacement_errors(errors_of({**forecasts, "constant_velocity": forecasts["mean"]}, windows.future))
    groups = window_errors(generator, group_windows(windows, 4))["all"]
    assert row["ade_m"]["mean"] == pytest.approx(groups["ade_m/mean"], rel=1e-3)
    assert row["fde_m"]["mean"] == pytest.approx(groups["fde_m/mean"], rel=1e-3)
    assert row["ade_m"]["best_of_20"] < row["ade_m"]["mean"] < 1.5 * row["ade_m"]["single"]


def test_without_noise_in_the_weights_all_samples_of_a_rollout_agree(scenes, sources):
    generator = small_generator(EXTRA_INPUTS)
    with torch.no_grad():
        generator.head.weight.zero_()
        generator.head.bias.zero_()
    forecasts = calibrated_forecasts(generator, sources, 8, STRIDE, CalibratedConfig(), samples=3)
    np.testing.assert_allclose(forecasts["single"], forecasts["mean"], atol=1e-5)
    # without a residual the anchor alone drives: along the road that is IDM with the driver's own headway
    idm = idm_forecasts(sources, 8, STRIDE)["idm_own_headway"]
    np.testing.assert_allclose(forecasts["mean"][..., 0], idm[..., 0], atol=1e-3)


def test_idm_keeps_the_lateral_position(sources):
    for course in idm_forecasts(sources, 8, STRIDE).values():
        np.testing.assert_allclose(course[..., 1], 0.0, atol=1e-5)
