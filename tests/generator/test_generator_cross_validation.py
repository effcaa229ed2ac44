import math
from dataclasses import asdict, replace

import polars as pl
import pytest
import torch

from ganlane.commands.train_generator import ablation_table, fold_tables
from ganlane.data import SyntheticTraffic, synthetic_scenes
from ganlane.data.statistics import measure_exposure
from ganlane.generator.checkpoint import load_generator
from ganlane.generator.cross_validation import ablate, cross_validate, variants
from ganlane.parameters.generator import CalibratedConfig, GeneratorSizes, LoopConfig, PaperConfig

SIZES = GeneratorSizes(embedding=16, hidden=16, pooling=12, pooled=8, context=16, noise=4)
LOOP = LoopConfig(updates=4, evaluate_every=2, warmup=1)
PAPER = PaperConfig(SIZES, loop=LOOP, stride=6, samples=2, batch=4)
DRIVER = replace(SIZES, extra_inputs=4)
CALIBRATED = CalibratedConfig(DRIVER, LOOP, (4,), (1.0,), held_out_horizon=8, batch=2, held_out_stride=20)


@pytest.fixture(scope="module")
def frame():
    return synthetic_scenes(SyntheticTraffic(scenes=3, vehicles=5, seconds=6.5))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fits")


@pytest.fixture(scope="module")
def scored(frame, folder):
    """Scores of three folds by preset, and each fold's generator."""
    results = {}
    for config in (PAPER, CALIBRATED):
        fits = {}
        scores = cross_validate(frame, config, 3, folder, on_fold=fits.__setitem__, source="folder/made.csv")
        results[config.preset] = scores, fits
    return results


def test_every_scene_is_forecast_once_by_a_generator_that_never_saw_it(scored):
    scores, _ = scored["paper"]
    assert {name for split in scores["splits"] for name in split["held_out"]} == set(scores["open_loop"]["scenes"])
    for split in scores["splits"]:
        assert not set(split["held_out"]) & {*split["fitted"], *split["validation"]}
    pooled = scores["open_loop"]
    assert pooled["windows"] == sum(row["windows"] for row in pooled["folds"].values()) > 0
    kinds = {"mean", "single", "best_of_20", "constant_velocity", "constant_acceleration", "ridge", "idm"}
    assert kinds <= set(pooled["ade_m"])
    assert "best_of_20" in fold_tables(scores)


def test_what_is_fitted_is_not_fitted_again_and_gives_the_same(frame, folder, scored):
    updates, fits = [], {}
    scores = cross_validate(frame, PAPER, 3, folder, on_progress=updates.append, on_fold=fits.__setitem__)
    first, first_fits = scored["paper"]
    assert scores == first
    assert not updates
    for number, fit in fits.items():
        for name, weights in fit.module.state_dict().items():
            assert torch.equal(weights, first_fits[number].module.state_dict()[name])
    cross_validate(frame, replace(PAPER, seed=1), 3, folder, on_progress=updates.append)
    assert len(updates) == 3 * LOOP.updates


def test_the_calibrated_preset_is_also_rolled_out_for_five_seconds(scored):
    scores, _ = scored["calibrated"]
    rollout = scores["rollout"]
    assert rollout["tracks"] == 15
    assert list(rollout["rmse_m"]["mean"]) == ["1 s", "2 s", "3 s", "4 s", "5 s"]
    assert rollout["ratio_to_constant_velocity"]["constant_velocity"] == 1.0
    assert scores["open_loop"]["windows"] > rollout["windows"]
    assert "Social-GAN (published)" in fold_tables(scores)


@pytest.mark.parametrize("preset", ["paper", "calibrated"])
def test_the_folds_generators_name_the_scenes_they_were_fitted_to(preset, frame, scored, tmp_path):
    scores, fits = scored[preset]
    assert list(fits) == [1, 2, 3]
    for fit, split in zip(fits.values(), scores["splits"]):
        fit.save(tmp_path / "fold.safetensors")
        _, metadata = load_generator(tmp_path / "fold.safetensors", preset)
        assert (metadata["data"]["held_out"], metadata["data"]["file"]) == (split["held_out"], "made.csv")
        # Its driving statistics are those of its other scenes.
        others = measure_exposure(frame.filter(~pl.col("scene").is_in(split["held_out"]))).vehicle_km
        assert 0.0 < metadata["driving_statistics"]["exposure"]["vehicle_km"] == others
        assert others < measure_exposure(frame).vehicle_km


SHORT_LOOP = LoopConfig(updates=4, evaluate_every=4, warmup=1)


def flat(config) -> dict:
    """Settings and the settings within them."""
    plain = asdict(config)
    parts = {key: part for key, part in plain.items() if isinstance(part, dict)}
    inner = {f"{key}.{name}": value for key, part in parts.items() for name, value in part.items()}
    return {key: value for key, value in plain.items() if key not in parts} | inner


@pytest.mark.parametrize("config", [PaperConfig(), CalibratedConfig()])
def test_every_variant_has_a_quarter_of_the_updates_and_differs_in_its_part_alone(config):
    first, *others = variants(config).items()
    assert flat(first[1])["loop.updates"] == config.loop.updates // 4
    for name, variant in others:
        changed = {key for key, value in flat(variant).items() if value != flat(first[1])[key]}
        assert 1 <= len(changed) <= (3 if name == "variety term alone" else 1), name


def test_ablations_of_the_papers_preset_stand_side_by_side(tmp_path):
    frame = synthetic_scenes(SyntheticTraffic(scenes=3, vehicles=5, seconds=5.0))
    config = replace(PAPER, loop=SHORT_LOOP)
    names, updates = [], []
    rows = ablate(frame, config, ("synthetic-1",), tmp_path, names.append, updates.append)
    assert list(rows) == names == list(variants(config))
    assert len(updates) == len(rows)
    assert rows["p_l = 4"]["windows"] > rows["p_l = 12"]["windows"]
    short = rows["p_l = 4"]
    assert short["ade_change_percent"] == short["ade_change_percent_0.4_s"]
    assert len(ablation_table(rows).splitlines()) == 2 + len(rows)


def test_ablations_of_the_calibrated_preset_are_rolled_out_too(tmp_path):
    frame = synthetic_scenes(SyntheticTraffic(scenes=3, vehicles=4, seconds=6.5))
    config = replace(CALIBRATED, loop=SHORT_LOOP)
    rows = ablate(frame, config, ("synthetic-1",), tmp_path)
    assert variants(config)["without washout"].washout_s == math.inf
    assert all(math.isfinite(row["rmse_5_s_ratio"]["mean"]) for row in rows.values())
    assert rows["as it is"] != rows["without traits"]
    assert "RMSE 5 s" in ablation_table(rows)
