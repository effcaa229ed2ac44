"""Fits of both presets: splits of scenes, losses, early stopping, resuming, stored weights."""

import json
import math
from dataclasses import asdict, replace

import pytest
import torch

from ganlane.data import SyntheticTraffic, synthetic_scenes
from ganlane.errors import UserError
from ganlane.generator.checkpoint import load_generator
from ganlane.generator.fit import assign_folds, fit_generator, learning_rate, split_for_fit
from ganlane.generator.networks import Generator
from ganlane.generator.segments import scene_tracks
from ganlane.generator.tasks import (
    CalibratedTask,
    adversarial_loss,
    discriminator_accuracy,
    discriminator_loss,
    distances,
    energy_score,
    masked_mean,
    variety_loss,
)
from ganlane.generator.windows import count_windows
from ganlane.parameters.generator import CalibratedConfig, GeneratorSizes, LoopConfig, LossWeights, PaperConfig
from ganlane.weights import save_weights

SIZES = GeneratorSizes(embedding=16, hidden=16, pooling=12, pooled=8, context=16, noise=4)
HELD_OUT = ("synthetic-1",)


@pytest.fixture(scope="module")
def frame():
    return synthetic_scenes(SyntheticTraffic(scenes=2, vehicles=8, seconds=7.0))


def paper_config(updates: int) -> PaperConfig:
    loop = LoopConfig(updates=updates, evaluate_every=10, learning_rate=5e-3, warmup=1)
    return PaperConfig(SIZES, LossWeights(), loop, stride=4, held_out_stride=8, samples=3, batch=8)


def calibrated_config(updates: int) -> CalibratedConfig:
    loop = LoopConfig(updates=updates, evaluate_every=3, learning_rate=5e-3, warmup=1)
    sizes = replace(SIZES, extra_inputs=4)
    return CalibratedConfig(
        sizes, loop, horizons=(4, 6), shares=(1, 1), held_out_horizon=8, batch=3, held_out_stride=20
    )


def test_fitting_the_paper_preset_lowers_its_error(frame):
    seen = []
    fit_generator("paper", frame, held_out=HELD_OUT, config=paper_config(40), on_progress=seen.append)
    losses = [progress.losses["mean"] for progress in seen]
    assert sum(losses[-5:]) < 0.9 * sum(losses[:5])
    assert {"variety", "single", "mean", "adversarial", "discriminator"} == set(seen[-1].losses)


def test_fitting_the_calibrated_preset_reports_the_held_out_scenes(frame):
    result = fit_generator("calibrated", frame, held_out=HELD_OUT, config=calibrated_config(3))
    assert set(result.metrics) == {"all", "synthetic-1"}
    assert result.data["fitted"] == ["synthetic-0"]
    assert result.updates == 3


def test_the_calibrated_loss_falls(frame):
    fitted, held_out = scene_tracks(frame)
    task = CalibratedTask([fitted], [held_out], calibrated_config(16))
    for optimiser in task.optimisers.values():
        optimiser.param_groups[0]["lr"] = 5e-3
    losses = [task.update(0)["mean"] for _ in range(16)]
    assert sum(losses[-5:]) < sum(losses[:5])


def test_save_and_load_give_the_same_network_and_its_description(frame, tmp_path):
    result = fit_generator("paper", frame, held_out=HELD_OUT, config=paper_config(2))
    path = tmp_path / "generator.safetensors"
    result.save(path)
    generator, metadata = load_generator(path, "paper")
    for name, tensor in result.module.state_dict().items():
        assert (generator.state_dict()[name] == tensor).all(), name
    assert metadata["config"] == json.loads(json.dumps(asdict(paper_config(2))))
    assert metadata["metrics"]["all"]["ade_m/mean"] == result.metrics["all"]["ade_m/mean"]
    assert {"headway", "lane_changes"} <= set(metadata["driving_statistics"])
    assert not any(parameter.requires_grad for parameter in generator.parameters())


def test_an_interrupted_fit_goes_on_to_the_same_weights(frame, tmp_path):
    whole = fit_generator("paper", frame, held_out=HELD_OUT, config=paper_config(16))
    path = tmp_path / "fit.pt"

    def stop(progress):
        if progress.update == 12:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_generator("paper", frame, held_out=HELD_OUT, config=paper_config(16), resume_path=path, on_progress=stop)
    resumed = fit_generator("paper", frame, held_out=HELD_OUT, config=paper_config(16), resume_path=path)
    for name, tensor in whole.module.state_dict().items():
        torch.testing.assert_close(resumed.module.state_dict()[name], tensor, msg=name)


def test_foreign_states_are_refused(frame, tmp_path):
    path = tmp_path / "fit.pt"
    path.write_bytes(b"not a state")
    with pytest.raises(UserError, match="not the state of a fit"):
        fit_generator("paper", frame, held_out=HELD_OUT, config=paper_config(2), resume_path=path)
    path.unlink()
    fit_generator("paper", frame, held_out=HELD_OUT, config=paper_config(2), resume_path=path)
    other = replace(paper_config(4), sizes=replace(SIZES, hidden=20))
    with pytest.raises(UserError, match="another fit"):
        fit_generator("paper", frame, held_out=HELD_OUT, config=other, resume_path=path)


def generator_file(path, sizes=None, preset="paper", tensors=None, kind="generator"):
    generator = Generator(SIZES)
    metadata = {"preset": preset, "sizes": asdict(SIZES) if sizes is None else sizes}
    save_weights(path, kind, generator.state_dict() if tensors is None else tensors, metadata)
    return path


def test_wrong_checkpoints_are_refused_in_one_sentence(tmp_path):
    path = tmp_path / "generator.safetensors"
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
        ({"sizes": {**asdict(SIZES), "hidden": 10**9}}, None, "not those of a generator"),
        ({"sizes": {**asdict(SIZES), "hidden": 20}}, None, "shapes"),
        ({"tensors": {"x": torch.zeros(2)}}, None, "shapes"),
        ({"preset": "calibrated"}, "calibrated", "further inputs"),
    ):
        with pytest.raises(UserError, match=message):
            load_generator(generator_file(path, **wrong), preset)


def test_a_preset_and_its_config_must_agree(frame):
    with pytest.raises(UserError, match="preset 'sgan'"):
        fit_generator("sgan", frame, held_out=HELD_OUT)
    with pytest.raises(UserError, match="PaperConfig"):
        fit_generator("calibrated", frame, held_out=HELD_OUT, config=paper_config(1))


def test_the_learning_rate_rises_and_then_falls_to_nothing():
    config = LoopConfig(updates=100, warmup=10, learning_rate=1e-2)
    rates = [learning_rate(config, number) for number in range(100)]
    assert rates[0] < rates[5] < rates[9]
    assert rates[10:] == sorted(rates[10:], reverse=True)
    assert rates[-1] < 1e-5


@pytest.fixture(scope="module")
def scenes():
    """Seven scenes of 2.5 to 8.5 s, so that they differ in their windows."""
    every = []
    for number in range(7):
        frame = synthetic_scenes(SyntheticTraffic(scenes=1, vehicles=6, seconds=2.5 + number), seed=number)
        (scene,) = scene_tracks(frame)
        every.append(type(scene)(**{**vars(scene), "name": f"scene-{number}"}))
    return every


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
        assert sorted(name for part in names.values() for name in part) == [scene.name for scene in scenes]
        assert tuple(names["held_out"]) == held_out
        others = [*split.fitted, *split.validation]
        held = sum(count_windows(scene) for scene in split.validation)
        total = sum(count_windows(scene) for scene in others)
        assert total / 12 <= held < total / 2


def test_a_single_other_scene_is_fitted_to_and_chooses_when_to_stop(scenes):
    split = split_for_fit(scenes[:2], ("scene-1",))
    assert split.names == {"fitted": ["scene-0"], "validation": ["scene-0"], "held_out": ["scene-1"]}


def test_more_folds_than_scenes_are_refused(scenes):
    with pytest.raises(UserError, match="folds=8"):
        assign_folds(scenes, 8)
    with pytest.raises(UserError, match="at least 3 scenes"):
        assign_folds(scenes[:2], 2)


@pytest.mark.parametrize("held_out", [("nowhere",), (), tuple(f"scene-{number}" for number in range(7))])
def test_a_split_without_two_parts_is_refused(scenes, held_out):
    with pytest.raises(UserError, match=r"data\.held_out="):
        split_for_fit(scenes, held_out)


def test_distance_is_euclidean_and_accumulates():
    predicted = torch.tensor([[[3.0, 4.0], [0.0, 0.0], [3.0, 4.0]]])
    torch.testing.assert_close(distances(predicted, torch.zeros(1, 3, 2)), torch.tensor([[5.0, 5.0, 10.0]]))


def test_the_gradient_of_a_perfect_prediction_is_finite():
    predicted = torch.zeros(1, 8, 2, requires_grad=True)
    distances(predicted, torch.zeros(1, 8, 2)).sum().backward()
    assert predicted.grad.isfinite().all()


def test_only_each_vehicles_best_sample_counts_for_variety():
    assert variety_loss(torch.tensor([[1.0, 9.0], [5.0, 3.0]])).item() == pytest.approx(2.0)


def test_masked_vehicles_do_not_count():
    values = torch.tensor([[1.0, 100.0]])
    assert masked_mean(values, torch.tensor([[True, False]])).item() == 1.0
    assert masked_mean(values, torch.zeros(1, 2, dtype=torch.bool)).item() == 0.0


def test_an_undecided_discriminator_loses_ln_2():
    zeros = torch.zeros(1, 2)
    assert discriminator_loss(zeros, zeros).item() == pytest.approx(math.log(2))
    assert adversarial_loss(zeros).item() == pytest.approx(math.log(2))


def test_accuracy_counts_both_kinds_alike():
    assert discriminator_accuracy(torch.ones(1, 2), -torch.ones(1, 2)).item() == 1.0
    assert discriminator_accuracy(torch.ones(1, 2), torch.ones(1, 2)).item() == 0.5


def test_the_energy_score_is_least_for_the_right_spread():
    torch.manual_seed(0)
    recorded = torch.randn(20000, 2)
    scores = {
        spread: energy_score(spread * torch.randn(20000, 2), spread * torch.randn(20000, 2), recorded).mean().item()
        for spread in (0.01, 0.5, 1.0, 1.5, 2.5)
    }
    assert min(scores, key=scores.get) == 1.0
