"""``generator=...``: the generator's presets, and how long they are fitted."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, cast

from ganlane.config.plain import plain_copy
from ganlane.errors import UserError
from ganlane.parameters.checks import above, at_least, between, check, every, one_of, optional

if TYPE_CHECKING:
    from ganlane.generator import CalibratedConfig, LoopConfig, LossWeights, PaperConfig, Preset


@dataclass
class LoopOptions:
    """``generator.loop`` (:class:`ganlane.generator.LoopConfig`)."""

    updates: int = 1200
    evaluate_every: int = 150
    patience: int = 8
    learning_rate: float = 4e-3
    warmup: int = 100
    largest_gradient: float = 1.0
    max_seconds: float | None = None

    def __post_init__(self) -> None:
        counts = dict.fromkeys(("updates", "evaluate_every", "patience"), at_least(1))
        positive = dict.fromkeys(("learning_rate", "largest_gradient"), above(0))
        check(self, "generator.loop", warmup=at_least(0), max_seconds=optional(above(0)), **counts, **positive)

    def parameters(self) -> LoopConfig:
        """As the fit takes it."""
        from ganlane.generator import LoopConfig

        return plain_copy(self, LoopConfig)


@dataclass
class CalibratedLoopOptions(LoopOptions):
    """The calibrated preset's: fewer updates, each through a whole stretch of a scene."""

    updates: int = 800
    evaluate_every: int = 80
    warmup: int = 40


@dataclass
class WeightOptions:
    """``generator.weights`` (:class:`ganlane.generator.LossWeights`)."""

    variety: float = 1.6
    single: float = 1.0
    mean: float = 1.0
    adversarial: float = 0.02

    def __post_init__(self) -> None:
        check(self, "generator.weights", **dict.fromkeys(("variety", "single", "mean", "adversarial"), at_least(0)))
        if self.variety == self.single == self.mean == 0:
            raise UserError("generator.weights: variety, single and mean are all 0; give one of them a weight.")

    def parameters(self) -> LossWeights:
        """As the fit takes them."""
        from ganlane.generator import LossWeights

        return plain_copy(self, LossWeights)


@dataclass
class GeneratorConfig:
    """What both presets have."""

    preset: str = "paper"
    batch: int = 48
    mirror: bool = True
    held_out_stride: int = 3

    def __post_init__(self) -> None:
        # Each option is the fit of one preset: generator=calibrated chooses the other, generator.preset does not.
        check(self, "generator", preset=one_of((type(self).preset,)), batch=at_least(1), held_out_stride=at_least(1))

    def preset_name(self) -> Preset:
        """The preset, checked."""
        return cast("Preset", self.preset)

    def fit_config(self, seed: int) -> PaperConfig | CalibratedConfig:
        """As :func:`ganlane.generator.fit_generator` takes it."""
        raise NotImplementedError


@dataclass
class PaperGeneratorConfig(GeneratorConfig):
    """``generator=paper`` (:class:`ganlane.generator.PaperConfig`): open loop, with a discriminator."""

    group_size: int = 9
    stride: int = 1
    samples: int = 6
    history_noise: float = 0.0
    predicted: int = 8
    neighbours: int = 8
    differences: bool = True
    loop: LoopOptions = field(default_factory=LoopOptions)
    weights: WeightOptions = field(default_factory=WeightOptions)

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = {"group_size": at_least(1), "stride": at_least(1), "samples": between(1, 100)}
        sizes = {"predicted": between(1, 50), "neighbours": between(0, 100)}
        check(self, "generator", history_noise=at_least(0), **counts, **sizes)

    def fit_config(self, seed: int) -> PaperConfig:
        """As the fit takes it."""
        from ganlane.generator import GeneratorSizes, PaperConfig

        return plain_copy(
            self,
            PaperConfig,
            sizes=plain_copy(self, GeneratorSizes),
            loop=self.loop.parameters(),
            weights=self.weights.parameters(),
            seed=seed,
        )


@dataclass
class CalibratedGeneratorConfig(GeneratorConfig):
    """``generator=calibrated`` (:class:`ganlane.generator.CalibratedConfig`): closed loop, whole scenes."""

    preset: str = "calibrated"
    batch: int = 6
    held_out_stride: int = 3
    horizons: list[int] = field(default_factory=lambda: [8, 16, 29])
    shares: list[float] = field(default_factory=lambda: [3.0, 1.0, 1.0])
    held_out_horizon: int = 29
    noise_period_s: float = 5.0
    washout_s: float = 3.0
    further_inputs: bool = True
    traits: bool = True
    loop: CalibratedLoopOptions = field(default_factory=CalibratedLoopOptions)

    def __post_init__(self) -> None:
        super().__post_init__()
        check(
            self,
            "generator",
            horizons=every(at_least(1)),
            shares=every(at_least(0)),
            washout_s=above(0),
            held_out_horizon=at_least(8),
            noise_period_s=at_least(0),
        )

    def fit_config(self, seed: int) -> CalibratedConfig:
        """As the fit takes it."""
        from ganlane.generator import CalibratedConfig

        return plain_copy(self, CalibratedConfig, loop=self.loop.parameters(), seed=seed)
