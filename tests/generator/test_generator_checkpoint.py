"""Files: generators saved, loaded and shipped, and the cache of arrays."""

import json
from dataclasses import asdict
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from reference.small_networks import SIZES, small_generator

from ganlane.data import default_scenes, read_scenes
from ganlane.errors import UserError
from ganlane.files import CACHE_VARIABLE, cache_folder
from ganlane.generator.checkpoint import (
    FitResult,
    cached,
    content_hash,
    load_generator,
    shipped_generator,
)
from ganlane.generator.fit import split_for_fit
from ganlane.generator.forecasts import (
    BASELINE,
    paper_forecasts,
    repeated,
    rollout_errors,
    scene_metrics,
)
from ganlane.generator.windows import cut_windows, group_windows, scene_tracks
from ganlane.parameters.generator import CalibratedConfig, PaperConfig
from ganlane.weights import save_weights

CONFIGS = {"paper": PaperConfig(), "calibrated": CalibratedConfig()}


def test_save_and_load_give_the_same_network_and_its_description(tmp_path):
    path, config = (
        tmp_path / "generator.safetensors",
        json.loads(json.dumps(asdict(CONFIGS["paper"]))),
    )
    module, metrics, statistics = small_generator(), {"all": {"ade_m/mean": 0.5}}, {"headway": {}}
    FitResult("paper", module, metrics, config, {"file": "a.csv"}, statistics, 7, 1.25).save(
        path, {"splits": []}
    )
    generator, metadata = load_generator(path, "paper")
    for name, tensor in module.state_dict().items():
        assert (generator.state_dict()[name] == tensor).all(), name
    assert not any(parameter.requires_grad for parameter in generator.parameters())
    assert metadata["metrics"] == {**metrics, "fit": {"updates": 7, "seconds": 1.2}}
    stored = [metadata[name] for name in ("config", "data", "driving_statistics", "folds")]
    assert stored == [config, {"file": "a.csv"}, statistics, {"splits": []}]


def test_wrong_checkpoints_are_refused_in_one_sentence(tmp_path):
    path, sizes = tmp_path / "generator.safetensors", asdict(SIZES)
    with pytest.raises(UserError, match="no such file"):
        load_generator(path)
    path.write_bytes(b"\x10\x00\x00")
    with pytest.raises(UserError, match="not a readable safetensors"):
        load_generator(path)
    for wrong, preset, message in (
        ({"kind": "agent"}, None, "expected a ganlane checkpoint of kind generator"),
        ({}, "calibrated", "expected 'calibrated'"),
        ({"preset": "own"}, None, "preset 'own'"),
        ({"sizes": {"hidden": 3}}, None, "not those of a generator"),
        ({"sizes": {**sizes, "hidden": 10**9}}, None, "not those of a generator"),
        ({"sizes": {**sizes, "hidden": 20}}, None, "shapes"),
        ({"tensors": {"x": torch.zeros(2)}}, None, "shapes"),
        ({"preset": "calibrated"}, "calibrated", "further inputs"),
        ({}, "paper", "no driving statistics"),
    ):
        given = {
            "kind": "generator",
            "preset": "paper",
            "sizes": sizes,
            "tensors": small_generator().state_dict(),
        }
        given |= wrong
        save_weights(path, given.pop("kind"), given.pop("tensors"), given)
        with pytest.raises(UserError, match=message):
            load_generator(path, preset)


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
        assert held_out[name] < share * held_out[f"{name.partition('/')[0]}/constant_velocity"], (
            name
        )


@pytest.mark.parametrize(
    ("preset", "least"),
    [("paper", {"mean": 15, "single": 5, "best_of_20": 35}), ("calibrated", {"mean": 9})],
)
def test_pooled_over_folds_the_errors_stay_under_constant_velocitys_and_stand_in_the_docs(
    preset, least
):
    folds = load_generator(shipped_generator(preset), preset)[1]["folds"]
    scores = folds["open_loop"]
    for kind, percent in least.items():
        assert scores["ade_change_percent"][kind] <= -percent, kind
    assert len(scores["folds"]) == 5
    large = [part for part in scores["parts"].values() if part["windows"] >= 500]
    assert large
    assert all(part["ade_change_percent"]["mean"] <= 0 for part in large)
    assert scores["direction_whole_window"]["share_right"]["mean"] >= 0.9
    if preset == "calibrated":
        assert folds["rollout"]["tracks"] > 400
        assert folds["rollout"]["ratio_to_constant_velocity"]["mean"] <= 0.75
    page = (Path(__file__).parents[2] / "docs" / "generator_results.md").read_text()
    for kind, text in (
        ("mean", "mean prediction"),
        ("single", "a single sample"),
        ("best_of_20", "best of 20"),
    ):
        row = next(
            line for line in page.splitlines() if line.startswith(f"| `generator_{preset}`, {text}")
        )
        figures = (f"{scores['ade_m'][kind]:.3f}", f"{scores['fde_m'][kind]:.3f}")
        assert all(
            figure in row for figure in (*figures, f"{scores['ade_change_percent'][kind]:+.1f} %")
        )


@pytest.fixture(scope="module")
def recordings():
    try:
        return read_scenes(default_scenes())
    except UserError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("preset", CONFIGS)
def test_the_stated_errors_are_those_of_the_shipped_weights(preset, recordings):
    generator, metadata = load_generator(shipped_generator(preset), preset)
    config = CONFIGS[preset]
    held_out = split_for_fit(
        scene_tracks(recordings), tuple(metadata["data"]["held_out"])
    ).held_out[:1]
    stated = metadata["metrics"][held_out[0].name]
    if preset == "paper":
        windows = cut_windows(held_out, config.held_out_stride)
        groups = group_windows(windows, config.group_size, config.seed)
        forecasts = paper_forecasts(generator, windows, groups, samples=0)
        forecasts[BASELINE] = repeated(windows.past[:, -1], 8)
        measured, names = (
            scene_metrics(windows, forecasts)["all"],
            ("fde_m/mean", "ade_m/constant_velocity"),
        )
    else:
        measured = rollout_errors(generator, held_out, config)["all"]
        names = ("end_m/mean", "end_m/constant_velocity")
    for name in ("ade_m/mean", "windows", *names):
        assert measured[name] == pytest.approx(stated[name], rel=0.01), name


ARRAYS = {"labels": np.arange(5), "more": np.ones((2, 3))}


def test_a_cached_result_is_computed_again_only_where_its_file_is_damaged(monkeypatch, tmp_path):
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    compute = Mock(return_value=ARRAYS)
    first, again = (cached("groups", "key", compute) for _ in range(2))
    assert compute.call_count == 1
    assert first.keys() == again.keys()
    assert all((first[name] == again[name]).all() for name in first)
    (file,) = tmp_path.iterdir()
    for damage in (b"", b"PK\x03\x04 half a file", b"something else"):
        file.write_bytes(damage)
        assert (cached("groups", "key", compute)["labels"] == np.arange(5)).all()
    assert compute.call_count == 4
    cached("groups", "another", compute)
    assert compute.call_count == 5


def test_where_the_cache_is_and_that_it_may_be_off_or_unwritable(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "file"))
    assert (cached("groups", "key", lambda: ARRAYS)["labels"] == np.arange(5)).all()
    monkeypatch.setenv(CACHE_VARIABLE, "")
    assert cache_folder() is None
    monkeypatch.delenv(CACHE_VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "ganlane"


def test_the_hash_sees_settings_values_shapes_and_types():
    values = np.arange(6.0)
    other = [
        (values + 1e-9,),
        (values.reshape(2, 3),),
        (values.astype(np.float32),),
        (values, values),
    ]
    hashes = {
        content_hash({"size": 8}, values),
        *(content_hash({"size": 9}, *given) for given in [(values,), *other]),
    }
    assert len(hashes) == 6
    assert content_hash({"a": 1, "b": 2}, values) == content_hash({"b": 2, "a": 1}, values.copy())
