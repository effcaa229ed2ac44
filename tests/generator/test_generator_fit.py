"""Splits of scenes, fits of both presets, k folds and ablations."""

import math
from dataclasses import asdict, replace

import polars as pl
import pytest
import torch
from reference.small_networks import CALIBRATED, LOOP, PAPER

from ganlane.commands.train_generator import ablation_table, fold_tables
from ganlane.data import SyntheticTraffic, synthetic_scenes
from ganlane.data.statistics import measure_exposure
from ganlane.errors import UserError
from ganlane.generator.checkpoint import load_generator
from ganlane.generator.fit import (
    ablate,
    assign_folds,
    cross_validate,
    fit_generator,
    split_for_fit,
    variants,
)
from ganlane.generator.windows import count_windows, scene_tracks
from ganlane.settings.generator import CalibratedConfig, LoopConfig, PaperConfig


@pytest.fixture(scope="module")
def scenes():
    """Seven scenes of 2.5 to 8.5 s, so that they differ in their windows."""
    frames = [
        synthetic_scenes(SyntheticTraffic(scenes=1, vehicles=6, seconds=2.5 + number), seed=number)
        for number in range(7)
    ]
    return [
        replace(scene_tracks(frame)[0], name=f"scene-{number}")
        for number, frame in enumerate(frames)
    ]


@pytest.mark.parametrize("folds", [2, 3, 5, 7])
def test_every_scene_is_reported_once_and_the_folds_are_about_equal(scenes, folds):
    assigned = assign_folds(scenes, folds)
    assert sorted(name for fold in assigned for name in fold) == [scene.name for scene in scenes]
    sizes = {scene.name: count_windows(scene) for scene in scenes}
    held = [sum(sizes[name] for name in fold) for fold in assigned]
    assert max(held) - min(held) <= max(sizes.values())
    assert assign_folds(scenes[::-1], folds) == assigned


def test_reported_scenes_have_no_say_in_when_to_stop(scenes):
    for held_out in assign_folds(scenes, 3):
        split = split_for_fit(scenes, held_out)
        names = split.names
        assert sorted(name for part in names.values() for name in part) == [
            scene.name for scene in scenes
        ]
        assert tuple(names["held_out"]) == held_out
        held = sum(map(count_windows, split.validation))
        total = held + sum(map(count_windows, split.fitted))
        assert total / 12 <= held < total / 2


def test_a_single_other_scene_is_fitted_to_and_chooses_when_to_stop(scenes):
    split = split_for_fit(scenes[:2], ("scene-1",))
    assert split.names == {
        "fitted": ["scene-0"],
        "validation": ["scene-0"],
        "held_out": ["scene-1"],
    }


def test_more_folds_than_scenes_and_splits_without_two_parts_are_refused(scenes):
    with pytest.raises(UserError, match="folds=8"):
        assign_folds(scenes, 8)
    with pytest.raises(UserError, match="at least 3 scenes"):
        assign_folds(scenes[:2], 2)
    for held_out in (("nowhere",), (), tuple(scene.name for scene in scenes)):
        with pytest.raises(UserError, match=r"data\.held_out="):
            split_for_fit(scenes, held_out)


@pytest.fixture(scope="module")
def frame():
    return synthetic_scenes(SyntheticTraffic(scenes=3, vehicles=5, seconds=6.5))


def test_a_fit_reports_the_held_out_scenes_and_its_preset_and_config_must_agree(frame):
    result = fit_generator(
        "calibrated", frame, held_out=("synthetic-1",), config=CALIBRATED, source="folder/made.csv"
    )
    assert set(result.metrics) == {"all", "synthetic-1"}
    assert {*result.data["fitted"], *result.data["validation"]} == {"synthetic-0", "synthetic-2"}
    assert (result.data["held_out"], result.data["file"]) == (["synthetic-1"], "made.csv")
    assert result.updates in (2, 4)
    assert {"headway", "lane_changes"} <= set(result.statistics)
    with pytest.raises(UserError, match="preset 'sgan'"):
        fit_generator("sgan", frame)
    with pytest.raises(UserError, match="PaperConfig"):
        fit_generator("calibrated", frame, config=PAPER)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fits")


@pytest.fixture(scope="module")
def scored(frame, folder):
    """Scores of three folds by preset, and each fold's generator."""
    results = {}
    for config in (PAPER, CALIBRATED):
        fits = {}
        scores = cross_validate(
            frame, config, 3, folder, on_fold=fits.__setitem__, source="folder/made.csv"
        )
        results[config.preset] = scores, fits
    return results


def test_every_scene_is_forecast_once_by_a_generator_that_never_saw_it(scored):
    scores, _ = scored["paper"]
    assert {name for split in scores["splits"] for name in split["held_out"]} == set(
        scores["open_loop"]["scenes"]
    )
    for split in scores["splits"]:
        assert not set(split["held_out"]) & {*split["fitted"], *split["validation"]}
    pooled = scores["open_loop"]
    assert pooled["windows"] == sum(row["windows"] for row in pooled["folds"].values()) > 0
    kinds = {
        "mean",
        "single",
        "best_of_20",
        "constant_velocity",
        "constant_acceleration",
        "ridge",
        "idm",
    }
    assert kinds <= set(pooled["ade_m"])
    assert "best_of_20" in fold_tables(scores)


def test_what_is_fitted_is_not_fitted_again_and_gives_the_same(frame, folder, scored):
    updates, fits = [], {}
    scores = cross_validate(
        frame, PAPER, 3, folder, on_progress=updates.append, on_fold=fits.__setitem__
    )
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
        assert (metadata["data"]["held_out"], metadata["data"]["file"]) == (
            split["held_out"],
            "made.csv",
        )
        # Its driving statistics are those of its other scenes.
        others = measure_exposure(
            frame.filter(~pl.col("scene").is_in(split["held_out"]))
        ).vehicle_km
        assert 0.0 < metadata["driving_statistics"]["exposure"]["vehicle_km"] == others
        assert others < measure_exposure(frame).vehicle_km


def flat(config) -> dict:
    """Settings and the settings within them."""
    plain = asdict(config)
    parts = {key: part for key, part in plain.items() if isinstance(part, dict)}
    inner = {f"{key}.{name}": value for key, part in parts.items() for name, value in part.items()}
    return {key: value for key, value in plain.items() if key not in parts} | inner


@pytest.mark.parametrize("config", [PaperConfig(), CalibratedConfig()])
def test_every_variant_has_a_quarter_of_the_updates_and_differs_in_its_part_alone(config):
    first, *others = ((name, flat(variant)) for name, variant in variants(config).items())
    assert first[1]["loop.updates"] == config.loop.updates // 4
    for name, variant in others:
        changed = {key for key, value in variant.items() if value != first[1][key]}
        assert 1 <= len(changed) <= (3 if name == "variety term alone" else 1), name


@pytest.mark.parametrize("config", [PAPER, CALIBRATED])
def test_ablations_stand_side_by_side_and_the_calibrated_ones_are_rolled_out_too(
    config, frame, tmp_path
):
    config = replace(config, loop=LoopConfig(updates=4, evaluate_every=4, warmup=1))
    names, updates = [], []
    told = (names.append, updates.append) if config.preset == "paper" else ()
    rows = ablate(frame, config, ("synthetic-1",), tmp_path, *told)
    assert list(rows) == list(variants(config))
    if config.preset == "calibrated":
        assert variants(config)["without washout"].washout_s == math.inf
        assert all(math.isfinite(row["rmse_5_s_ratio"]["mean"]) for row in rows.values())
        assert rows["as it is"] != rows["without traits"]
        assert "RMSE 5 s" in ablation_table(rows)
    else:
        assert (names, len(updates)) == (list(rows), len(rows))
        short = rows["p_l = 4"]
        assert short["windows"] > rows["p_l = 12"]["windows"]
        assert short["ade_change_percent"] == short["ade_change_percent_0.4_s"]
        assert len(ablation_table(rows).splitlines()) == 2 + len(rows)
