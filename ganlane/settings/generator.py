"""Recordings and the fit of the generator to them.

Files and held-out scenes, sizes, schedule, both presets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal, get_args

from ganlane.errors import ParameterError, UserError
from ganlane.files import CHECKPOINTS
from ganlane.settings.record import (
    NO_KEY,
    Count,
    CountOrZero,
    NotNegative,
    Positive,
    Record,
    Text,
    assign,
    at_least,
    between,
    part_of,
)

Preset = Literal["paper", "calibrated"]
#: Kind of their files; weights of another kind, such as an agent's, are refused by it.
GENERATOR = "generator"
#: Inputs of the calibrated preset in addition to the motion: IDM's acceleration, gap, closing
#: speed, lane offset.
EXTRA_INPUTS = 4
#: The bound keeps a file of weights from requesting all memory.
_Width = Annotated[int, between(1, 4096)]


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
        extra_inputs: inputs per vehicle in addition to its motion (0 for the paper's preset,
            positions only).
        observed: displacements that are observed (the paper's ``o_l``).
        predicted: displacements that are predicted (the paper's ``p_l``).
        differences: whether the displacements' differences are inputs too; false is for an
            ablation.
    """

    # widths of layers: set from Python alone
    embedding: _Width = field(default=64, metadata=NO_KEY)
    hidden: _Width = field(default=32, metadata=NO_KEY)
    pooling: _Width = field(default=48, metadata=NO_KEY)
    pooled: _Width = field(default=32, metadata=NO_KEY)
    context: _Width = field(default=64, metadata=NO_KEY)
    noise: _Width = field(default=8, metadata=NO_KEY)
    neighbours: Annotated[int, between(0, 100)] = 8
    extra_inputs: Annotated[int, between(0, 4096)] = field(default=0, metadata=NO_KEY)
    observed: _Width = field(default=8, metadata=NO_KEY)
    predicted: Annotated[int, between(1, 50)] = 8
    differences: bool = True


def shipped_generator(preset: Preset | Literal["human", "human_1"]) -> Path:
    """Path of the weights that come with the package; ``human_1``: those of the suite shift-v1."""
    return CHECKPOINTS / f"generator_{preset}.safetensors"


def stored_sizes(path: object, metadata: Mapping[str, Any], preset: str | None) -> GeneratorSizes:
    """The sizes of a generator from the ``metadata`` of its file.

    ``path`` is for messages, ``preset`` the required one; None accepts any.

    Raises:
        UserError: another preset, no sizes of a generator, or no driving statistics.
    """
    # str, since a foreign file may hold anything under this name.
    stored = str(metadata.get("preset"))
    if stored not in get_args(Preset) or (preset is not None and stored != preset):
        expected = preset or "paper or calibrated"
        raise UserError(
            f"{path}: a generator of preset {stored!r}, expected {expected!r}; give one."
        )
    checked: GeneratorSizes = _sizes_in(path, metadata, GeneratorSizes)
    if checked.noise >= checked.hidden:
        raise misfit(path, vars(checked))
    # The presets differ in their inputs; weights of one would drive badly under the other's name.
    needed = EXTRA_INPUTS if stored == "calibrated" else 0
    if checked.extra_inputs != needed:
        raise UserError(
            f"{path}: takes {checked.extra_inputs} further inputs, expected {needed} for the "
            f"preset {stored}; fit it again."
        )
    # Traffic takes headways and lane changes from them, so weights alone cannot drive.
    if not isinstance(metadata.get("driving_statistics"), dict):
        raise UserError(f"{path}: holds no driving statistics of its recordings; fit it again.")
    return checked


#: Numbers that a driver of ``human`` sees, and that it sees of a lane beside its own.
FEATURES, SIDE_FEATURES = 65, 17
#: Tokens of its acceleration and of its lateral speed.
ALONG_TOKENS, ACROSS_TOKENS = 41, 31
#: Its memory: name to numbers per driver (``ganlane.generator.human.Memory``).
HUMAN_MEMORY: Final[Mapping[str, int]] = MappingProxyType(
    {"accelerations": 5, "lateral_speeds": 2, "closing": 2, "style": 3, "age": 1, "since": 1}
)


@dataclass(frozen=True)
class HumanSizes(Record):
    """Widths of the policy of ``human``; stored with its weights.

    Attributes:
        hidden: width of both layers behind the acceleration and the lateral speed.
        lane_hidden: width of the layer behind lane changes.
    """

    hidden: Annotated[int, between(1, 512)] = 128
    lane_hidden: Annotated[int, between(1, 512)] = 32


def human_sizes(path: object, metadata: Mapping[str, Any]) -> HumanSizes:
    """The sizes of a policy of ``human`` from the ``metadata`` of its file.

    Raises:
        UserError: another preset, or no sizes of such a policy; ``path`` is for the message.
    """
    stored = str(metadata.get("preset"))
    if stored != "human":
        raise UserError(f"{path}: a generator of preset {stored!r}, expected 'human'; give one.")
    return _sizes_in(path, metadata, HumanSizes)


def _sizes_in(path: object, metadata: Mapping[str, Any], kind: Any) -> Any:
    """The record of class ``kind`` in the ``metadata`` of a file."""
    sizes = metadata.get("sizes")
    # The defaults tell the types, since a text or a float would fail only where layers are made.
    types = {field.name: type(field.default) for field in fields(kind)}
    try:
        if {name: type(size) for name, size in dict(sizes or {}).items()} != types:
            raise ValueError("other names or types")
        return kind(**sizes)  # type: ignore[arg-type]
    except (TypeError, ValueError, ParameterError) as error:
        raise misfit(path, sizes) from error


def misfit(path: object, sizes: object) -> UserError:
    """The error of a file whose weights have no such sizes."""
    return UserError(f"{path}: its weights do not fit the sizes {sizes}; fit it again.")


@dataclass(frozen=True)
class LossWeights(Record):
    """Weights of the generator's loss terms; a weight of 0 switches a term off.

    Attributes:
        variety: the best of the samples (variety alone makes a single sample worse than constant
            velocity).
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
        # The adversarial term alone says nothing about where a vehicle goes.
        if self.variety == self.single == self.mean == 0:
            raise ParameterError(
                "{variety}=0: {single} and {mean} are 0, too; give one of them a weight."
            )


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
    """

    # how long
    updates: Count = 1200
    evaluate_every: Count = 150
    patience: Count = 8
    # how fast
    learning_rate: Positive = 4e-3
    warmup: CountOrZero = 100
    largest_gradient: Positive = 1.0


@dataclass(frozen=True)
class FitConfig(Record):
    """Settings of a fit: those of one preset or the other.

    Attributes:
        preset: chosen with the option: generator=calibrated.
        seed: of weights, batches, noise, k-means and drivers' parameters.
    """

    group = "generator"
    chosen_by = "preset"

    preset: str = field(kw_only=True)
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
        samples: samples per update; the best counts in the variety term.
        batch: groups per update.
    """

    preset: str = field(default="paper", kw_only=True)
    sizes: GeneratorSizes = GeneratorSizes()
    weights: LossWeights = LossWeights()
    loop: LoopConfig = LoopConfig()
    # how windows are cut from the recordings
    group_size: Count = 9
    stride: Count = 1
    held_out_stride: Count = 3
    # one update
    samples: Annotated[int, between(1, 100)] = 6
    batch: Count = 48


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
    """

    preset: str = field(default="calibrated", kw_only=True)
    sizes: GeneratorSizes = field(
        default_factory=lambda: GeneratorSizes(extra_inputs=EXTRA_INPUTS), metadata=NO_KEY
    )
    loop: LoopConfig = field(
        default_factory=lambda: LoopConfig(updates=800, evaluate_every=80, warmup=40)
    )
    # how far scenes are rolled out
    # 0.8, 1.6 and 2.9 s; most updates take the shortest, which costs least
    horizons: tuple[Count, ...] = (8, 16, 29)
    shares: tuple[NotNegative, ...] = (3.0, 1.0, 1.0)
    held_out_horizon: Annotated[int, at_least(8)] = 29
    batch: Count = 6
    held_out_stride: Count = 3
    # what makes drivers differ
    noise_period_s: NotNegative = 5.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.shares) != len(self.horizons) or sum(self.shares) <= 0:
            raise ParameterError(
                f"{{shares}}={list(self.shares)}: give one share of the updates for each of the "
                "horizons "
                f"{list(self.horizons)}, not all 0."
            )


@dataclass(frozen=True)
class HumanConfig(FitConfig):
    """Settings of the fit of ``human``: cloning, closed-loop samples, fine-tuning in simulation.

    It is fitted to the files of one lane beside the recordings (I-80, I-24), too, where they are.

    Attributes:
        sizes: of the policy.
        cutoff_hz: recorded positions along the road are smoothed; of this frequency half is left.
        lateral_cutoff_hz: the same across the road.
        faster_mps: in further copies of the recordings everybody is faster, by up to this much,
            m/s; gaps and accelerations are the same.
        epochs: passes over the samples in cloning.
        rounds: closed-loop rounds after it.
        samples: moves drawn per decision in them, of which the nearest to the recording counts.
        learning_rate: of Adam in cloning.
        tuning: iterations of the fine-tuning; 0: none.
        pull: weight of the divergence from the cloned policy in it.
        settling: iterations of two more, each after lane changes were made as frequent as recorded.
        observing: updates of the observer, which adds a camera's errors to forecasts: so many to
            the recorded ones, and again with those of other sensors.
    """

    preset: str = field(default="human", kw_only=True)
    sizes: HumanSizes = HumanSizes()
    # what is fitted to
    cutoff_hz: Positive = 0.6
    lateral_cutoff_hz: Positive = 0.4
    faster_mps: NotNegative = 15.0
    # cloning
    epochs: Count = 8
    rounds: CountOrZero = 3
    samples: Annotated[int, between(1, 100)] = 6
    learning_rate: Positive = 2e-3
    # in simulation
    tuning: CountOrZero = 150
    pull: NotNegative = 0.15
    settling: CountOrZero = 80
    # of forecasts alone
    observing: Count = 20_000


#: Bytes of a file that are read at once: about 300,000 rows of NGSIM, which take a few times as
#: much memory.
BLOCK_BYTES = 32 * 2**20
#: NGSIM's locations without crossings.
MOTORWAYS = ("us-101", "i-80")


@dataclass(frozen=True)
class NgsimParameters(Record):
    """Which rows of an NGSIM file are read.

    Attributes:
        locations: places to keep, where the file names them; lankershim and peachtree have
            crossings.
        lanes: number of lanes kept, counted from the left; on US-101 and I-80 lanes 1 to 6 are the
            main lanes (and US-101's auxiliary lane), higher numbers are ramps.
        block_bytes: bytes read at once.
    """

    locations: tuple[Text, ...] = MOTORWAYS
    lanes: Count = 6
    block_bytes: Count = field(default=BLOCK_BYTES, metadata=NO_KEY)

    def __post_init__(self) -> None:
        super().__post_init__()
        # Upper or lower case makes no difference.
        assign(self, locations=tuple(place.lower() for place in self.locations))


@dataclass(frozen=True)
class DataConfig(Record):
    """``data=scenes``: scene CSV, or what ``ganlane prepare`` wrote
    (:func:`ganlane.data.read_scenes`).

    Attributes:
        format: chosen with the option: ``data=ngsim``.
        path: file or folder; null: US-101 below GANLANE_DATA or ../shared/data.
        held_out: names of scenes not to fit to; null: those of the shipped weights, else every
            third scene.
    """

    group = "data"
    chosen_by = "format"

    format: str = "scenes"
    path: str | None = None
    held_out: tuple[Text, ...] | None = None

    def parameters(self) -> NgsimParameters | None:
        """Further inputs of the reader; None where it takes nothing."""
        return None

    def held_out_scenes(self, scenes: Sequence[str], preferred: Sequence[str]) -> tuple[str, ...]:
        """The scenes not to fit to, of ``scenes`` in the recordings.

        ``preferred`` where they are all there.
        """
        if self.held_out is not None:
            return self.held_out
        # Every third by name, from the second on: a choice that no recording influences.
        return tuple(preferred) if set(preferred) <= set(scenes) else tuple(sorted(scenes)[1::3])


@dataclass(frozen=True)
class NgsimDataConfig(NgsimParameters, DataConfig):
    """``data=ngsim``: NGSIM's text files or the portal's CSV (:func:`ganlane.data.ngsim_scenes`).

    Attributes:
        path: the file.
        held_out: names of scenes not to fit to.
    """

    format: str = "ngsim"

    def parameters(self) -> NgsimParameters:
        """As the reader takes it."""
        return part_of(self, NgsimParameters)


@dataclass(frozen=True)
class HighdDataConfig(DataConfig):
    """``data=highd``: a folder of highD recordings, or one ``XX_tracks.csv``
    (:func:`ganlane.data.highd_scenes`).

    Attributes:
        path: the folder, or one XX_tracks.csv.
        held_out: names of scenes not to fit to.
    """

    format: str = "highd"
