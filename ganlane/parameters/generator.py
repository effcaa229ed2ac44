"""Fitting the generator: its sizes, the schedule, and the settings of both presets."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

from ganlane.errors import ParameterError
from ganlane.parameters.checks import (
    NO_KEY,
    Count,
    CountOrZero,
    NotNegative,
    Positive,
    Record,
    Rule,
    at_least,
    between,
)

Preset = Literal["paper", "calibrated"]
#: Inputs of the calibrated preset in addition to the motion: IDM's acceleration, gap, closing speed, lane offset.
EXTRA_INPUTS = 4
_WASHOUT = Rule(lambda value: value > 0 and not math.isnan(value), "a number above 0, or inf")


@dataclass(frozen=True)
class GeneratorSizes(Record):
    """Widths of the generator; stored with its weights. Three of them are keys of the command line.

    Attributes:
        embedding: width of the motions' embedding (the paper's ``s_MLP``).
        hidden: width H of both LSTMs.
        pooling: width of the pooling's first layer.
        pooled: width of its result.
        context: width of the layer between encoder and decoder.
        noise: width Z of the latent vector; below ``hidden``.
        neighbours: how many of the nearest vehicles are pooled; 0 is no pooling (an ablation).
        extra_inputs: inputs per vehicle in addition to its motion (0 for the paper's preset, positions only).
        observed: displacements that are observed (the paper's ``o_l``).
        predicted: displacements that are predicted (the paper's ``p_l``).
        differences: whether the displacements' differences are inputs too; false is for an ablation.
    """

    embedding: int = field(default=64, metadata=NO_KEY)
    hidden: int = field(default=32, metadata=NO_KEY)
    pooling: int = field(default=48, metadata=NO_KEY)
    pooled: int = field(default=32, metadata=NO_KEY)
    context: int = field(default=64, metadata=NO_KEY)
    noise: int = field(default=8, metadata=NO_KEY)
    neighbours: Annotated[int, between(0, 100)] = 8
    extra_inputs: int = field(default=0, metadata=NO_KEY)
    observed: int = field(default=8, metadata=NO_KEY)
    predicted: Annotated[int, between(1, 50)] = 8
    differences: bool = True


@dataclass(frozen=True)
class LossWeights(Record):
    """Weights of the generator's loss terms; a weight of 0 switches a term off.

    Attributes:
        variety: the best of the samples (variety alone makes a single sample worse than constant velocity).
        single: the mean over the samples.
        mean: the prediction for z = 0.
        adversarial: cross-entropy of the discriminator's logits.
    """

    variety: NotNegative = 1.6
    single: NotNegative = 1.0
    mean: NotNegative = 1.0
    adversarial: NotNegative = 0.02

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.variety == self.single == self.mean == 0:
            raise ParameterError("{variety}=0: {single} and {mean} are 0, too; give one of them a weight.")


@dataclass(frozen=True)
class LoopConfig(Record):
    """How long to fit.

    Attributes:
        updates: updates at most; the learning rate falls to 0 over them.
        evaluate_every: updates between two evaluations on the validation scenes.
        patience: evaluations without improvement before stopping.
        learning_rate: of Adam, after the warm-up.
        warmup: updates over which the learning rate rises.
        largest_gradient: norm at which gradients are clipped.
        max_seconds: stop after this long, s; null: never.
    """

    updates: Count = 1200
    evaluate_every: Count = 150
    patience: Count = 8
    learning_rate: Positive = 4e-3
    warmup: CountOrZero = 100
    largest_gradient: Positive = 1.0
    max_seconds: Positive | None = None


@dataclass(frozen=True)
class FitConfig(Record):
    """Settings of a fit: those of one preset or the other.

    Attributes:
        seed: of weights, batches, noise, k-means and drivers' parameters.
    """

    preset: ClassVar[Preset]
    seed: int = field(default=0, kw_only=True, metadata=NO_KEY)


@dataclass(frozen=True)
class PaperConfig(FitConfig):
    """Settings of the paper's fit.

    Attributes:
        sizes: of the generator.
        weights: of the loss terms.
        loop: the schedule.
        group_size: approximate number of vehicles per k-means group.
        stride: frames between the starts of two windows, in fitting.
        held_out_stride: the same on validation and held-out scenes.
        history_noise: in fitting, standard deviation of noise on the observed displacements, in units of a typical
            difference (0.04 m along and 0.02 m across the road); 0 is no noise.
        samples: samples per update; the best counts in the variety term.
        batch: groups per update.
        mirror: swap left and right in half of the groups.
    """

    preset: ClassVar[Preset] = "paper"
    sizes: GeneratorSizes = field(default_factory=GeneratorSizes)
    weights: LossWeights = field(default_factory=LossWeights)
    loop: LoopConfig = field(default_factory=LoopConfig)
    group_size: Count = 9
    stride: Count = 1
    held_out_stride: Count = 3
    samples: Annotated[int, between(1, 100)] = 6
    history_noise: NotNegative = 0.0
    batch: Count = 48
    mirror: bool = True


@dataclass(frozen=True)
class CalibratedConfig(FitConfig):
    """Settings of the calibrated fit.

    Attributes:
        sizes: of the generator.
        loop: the schedule: fewer updates than the paper's, each through a whole stretch of a scene.
        horizons: steps rolled out; every update draws one of them.
        shares: relative frequency of each horizon.
        held_out_horizon: steps rolled out in evaluation.
        batch: segments per update.
        held_out_stride: frames between the starts of the segments in evaluation.
        noise_period_s: time constant of each driver's latent vector, s.
        mirror: swap left and right in half of the updates.
        washout_s: time constant of the residual's mean, which is subtracted, s; inf: without washout. The simulation
            uses the value stored with the weights.
        further_inputs: whether the network gets gap, closing speed, IDM's acceleration and lane offset.
        traits: whether every driver has its own headway and desired speed.
    """

    preset: ClassVar[Preset] = "calibrated"
    sizes: GeneratorSizes = field(default_factory=lambda: GeneratorSizes(extra_inputs=EXTRA_INPUTS), metadata=NO_KEY)
    loop: LoopConfig = field(default_factory=lambda: LoopConfig(updates=800, evaluate_every=80, warmup=40))
    horizons: tuple[Count, ...] = (8, 16, 29)
    shares: tuple[NotNegative, ...] = (3.0, 1.0, 1.0)
    held_out_horizon: Annotated[int, at_least(8)] = 29
    batch: Count = 6
    held_out_stride: Count = 3
    noise_period_s: NotNegative = 5.0
    mirror: bool = True
    washout_s: Annotated[float, _WASHOUT] = 3.0
    further_inputs: bool = True
    traits: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.shares) != len(self.horizons) or sum(self.shares) <= 0:
            raise ParameterError(
                f"{{shares}}={list(self.shares)}: give one share of the updates for each of the horizons "
                f"{list(self.horizons)}, not all 0."
            )
