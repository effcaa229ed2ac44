"""Generators saved, loaded and shipped."""

import json
from dataclasses import asdict

import pytest
import torch
from reference.processes import ROOT
from reference.refusals import user_error
from reference.small_networks import SIZES, small_generator

from ganlane.data.dense import recordings_of
from ganlane.generator.checkpoint import FitResult, load_generator
from ganlane.generator.fit import held_out_errors, split_for_fit
from ganlane.generator.forecasts import displacement_errors, rollout_score
from ganlane.generator.tasks import PaperTask
from ganlane.generator.windows import count_windows
from ganlane.native.drivers import drivers_of
from ganlane.settings.driving import IdmParameters, MobilParameters
from ganlane.settings.episode import Stream
from ganlane.settings.generator import CalibratedConfig, PaperConfig, shipped_generator
from ganlane.settings.traffic import GanTrafficConfig
from ganlane.weights import save_weights

CONFIGS = {"paper": PaperConfig(), "calibrated": CalibratedConfig()}


def plain(record):
    """Settings as a file holds them."""
    return json.loads(json.dumps(asdict(record)))


def test_save_and_load_give_the_same_network_and_its_description(tmp_path):
    path = tmp_path / "generator.safetensors"
    fitted = FitResult(
        PaperConfig(),
        small_generator(),
        metrics={"all": {"ade_m/mean": 0.5}},
        updates=7,
        seconds=1.25,
        data={"file": "a.csv"},
        statistics={"headway": {}},
    )
    fitted.save(path, folds={"splits": []})
    generator, metadata = load_generator(path, "paper")
    for name, tensor in fitted.module.state_dict().items():
        assert (generator.state_dict()[name] == tensor).all(), name
    assert not any(parameter.requires_grad for parameter in generator.parameters())
    described = {
        "metrics": {**fitted.metrics, "fit": {"updates": 7, "seconds": 1.2}},
        "config": plain(fitted.config),
        "data": fitted.data,
        "driving_statistics": fitted.statistics,
        "folds": {"splits": []},
    }
    assert described.items() <= metadata.items()


PLAIN_SIZES = asdict(SIZES)
MISFIT = "do not fit the sizes"


@pytest.mark.parametrize(
    ("wrong", "preset", "message"),
    [
        ({"kind": "agent"}, None, "expected a ganlane checkpoint of kind generator"),
        ({}, "calibrated", "expected 'calibrated'"),
        ({"preset": "human"}, None, "preset 'human'"),
        # Of no network, of one that cannot be, of another, and no sizes or tensors at all.
        ({"sizes": None}, None, MISFIT),
        ({"sizes": PLAIN_SIZES | {"hidden": 10**9}}, None, MISFIT),
        ({"sizes": PLAIN_SIZES | {"neighbours": True}}, None, MISFIT),
        ({"sizes": PLAIN_SIZES | {"noise": 20}}, None, MISFIT),
        ({"sizes": PLAIN_SIZES | {"hidden": 20}}, None, MISFIT),
        ({"tensors": {"x": torch.zeros(2)}}, None, MISFIT),
        ({"preset": "calibrated"}, "calibrated", "further inputs"),
        ({"driving_statistics": None}, "paper", "no driving statistics"),
    ],
)
def test_wrong_checkpoints_are_refused_in_one_sentence(wrong, preset, message, tmp_path):
    content = {
        "kind": "generator",
        "preset": "paper",
        "sizes": PLAIN_SIZES,
        "tensors": small_generator().state_dict(),
        "driving_statistics": {},
        **wrong,
    }
    path = tmp_path / "generator.safetensors"
    save_weights(path, content.pop("kind"), content.pop("tensors"), content)
    with user_error(message):
        load_generator(path, preset)
    # The kernel reads the same files without torch.
    if preset != "calibrated":
        traffic = GanTrafficConfig(path=str(path))
        with user_error(message):
            drivers_of(traffic, IdmParameters(), MobilParameters(), Stream.TRAIN)


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
    stored = {**metadata["config"], "preset": metadata["preset"]}
    # Options that went since then were at what the fit does now.
    assert stored["loop"].pop("max_seconds") is None
    gone = {
        "history_noise": 0.0,
        "mirror": True,
        "traits": True,
        "washout_s": 3.0,
        "further_inputs": True,
    }
    assert gone | stored == gone | plain(CONFIGS[preset])
    assert 0 < metadata["metrics"]["fit"]["seconds"] < 1800
    errors = metadata["metrics"]["all"]
    for name, share in most.items():
        error, _, _ = name.partition("/")
        assert errors[name] < share * errors[f"{error}/constant_velocity"], name


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
    page = (ROOT / "docs" / "generators.md").read_text()
    texts = {"mean": "mean prediction", "single": "a single sample", "best_of_20": "best of 20"}
    for kind, text in texts.items():
        begin = f"| `generator_{preset}`, {text}"
        row = next(line for line in page.splitlines() if line.startswith(begin))
        for error in ("ade_m", "fde_m"):
            assert f"{scores[error][kind]:.3f}" in row
        assert f"{scores['ade_change_percent'][kind]:+.1f} %" in row


@pytest.mark.parametrize("preset", CONFIGS)
def test_the_stated_errors_are_those_of_the_shipped_weights(preset, us101_scenes):
    generator, metadata = load_generator(shipped_generator(preset), preset)
    config = CONFIGS[preset]
    split = split_for_fit(recordings_of(us101_scenes), tuple(metadata["data"]["held_out"]))
    if preset == "calibrated":
        # The first, whose samples are those of the statement.
        scenes = split.held_out[:1]
        stated = metadata["metrics"][scenes[0].name]
        score = 0.5 * (stated["relative_mean"] + stated["relative_energy"])
        assert rollout_score(generator, scenes, config) == pytest.approx(score, rel=0.01)
        return
    scenes = [min(split.held_out, key=count_windows)]
    stated = metadata["metrics"][scenes[0].name]
    task = PaperTask(scenes, scenes, config)
    task.generator = generator
    measured = displacement_errors(held_out_errors(task, scenes, 8, config.held_out_stride)[1])
    assert measured["windows"] == stated["windows"]
    for error, kind in (("ade_m", "mean"), ("fde_m", "mean"), ("ade_m", "constant_velocity")):
        assert measured[error][kind] == pytest.approx(stated[f"{error}/{kind}"], rel=0.01)
