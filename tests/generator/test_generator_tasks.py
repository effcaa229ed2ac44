"""What is fitted: losses, updates and scores of both presets.

The loop stops early.
"""

import math
from dataclasses import replace

import pytest
import torch
from reference.small_networks import CALIBRATED, PAPER

from ganlane.generator import tasks
from ganlane.settings.generator import LoopConfig


def paper_task(scenes, **changes):
    loop = LoopConfig(evaluate_every=5, learning_rate=1e-2, warmup=1, **changes)
    fitted, validation = scenes
    return tasks.PaperTask(
        [fitted], [validation], replace(PAPER, loop=loop, stride=4, samples=3, batch=8)
    )


def test_fitting_the_papers_preset_lowers_its_error(scenes):
    seen = []
    paper_task(scenes, updates=25).fit("fit", seen.append)
    losses = [progress.losses["mean"] for progress in seen]
    assert sum(losses[-5:]) < 0.9 * sum(losses[:5])
    assert set(seen[-1].losses) == {"variety", "single", "mean", "adversarial", "discriminator"}


def test_a_fit_ends_with_the_weights_that_were_best_and_without_patience_soon(scenes):
    task = paper_task(scenes, updates=20, patience=1)
    seen = []
    scores = iter([3.0, 2.0, 2.5, 1.0])
    weights = {}

    def evaluate():
        weights[len(seen) + 1] = task.generator.head.weight.clone()
        return next(scores)

    task.evaluate = evaluate
    assert task.fit("fit", seen.append) == 10
    assert seen[-1].update == 15
    assert torch.equal(task.generator.head.weight, weights[10])


def test_the_calibrated_loss_falls(scenes):
    fitted, validation = scenes
    task = tasks.CalibratedTask(
        [fitted], [validation], replace(CALIBRATED, horizons=(4, 6), shares=(1.0, 1.0), batch=3)
    )
    task.optimisers["generator"].param_groups[0]["lr"] = 5e-3
    losses = [task.update(0)["mean"] for _ in range(16)]
    assert sum(losses[-5:]) < sum(losses[:5])


def test_losses_by_hand():
    # What is masked does not count.
    values = torch.tensor([[1.0, 100.0]])
    assert tasks.masked_mean(values, torch.tensor([[True, False]])).item() == 1.0
    assert tasks.masked_mean(values, torch.zeros(1, 2, dtype=torch.bool)).item() == 0.0
    # An undecided discriminator loses ln 2.
    zeros = torch.zeros(1, 2)
    for recorded in (0.0, 1.0):
        assert tasks.cross_entropy(zeros, recorded).item() == pytest.approx(math.log(2))
