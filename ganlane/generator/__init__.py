"""The Social-GAN (section III of the paper): from recorded trajectories to a network that drives.

Read in this order:

- recordings to batches: ``segments`` (of scenes), ``windows`` (9 positions observed, 8 to predict; k-means groups);
- ``networks``: generator and discriminator;
- closed loop: ``closed_loop`` (one step of each preset, in fitting and in simulation), ``rollout`` (whole scenes);
- fitting: ``tasks`` (of both presets), ``fit`` (splits, early stopping, resuming, one call), ``checkpoint``;
- measuring: ``forecasts`` (networks, IDM, baselines; scores), ``cross_validation`` (folds by scene, ablations).
"""

from ganlane.generator.checkpoint import FitResult, Preset, load_generator, shipped_generator
from ganlane.generator.closed_loop import ANCHOR, AnchorParameters
from ganlane.generator.cross_validation import ablate, cross_validate
from ganlane.generator.fit import HELD_OUT, Progress, assign_folds, fit_generator, fit_key, split_for_fit
from ganlane.generator.networks import Discriminator, Generator
from ganlane.generator.rollout import headway_quantiles
from ganlane.generator.segments import scene_tracks
from ganlane.parameters.generator import CalibratedConfig, GeneratorSizes, LoopConfig, LossWeights, PaperConfig

__all__ = [
    "ANCHOR",
    "HELD_OUT",
    "AnchorParameters",
    "CalibratedConfig",
    "Discriminator",
    "FitResult",
    "Generator",
    "GeneratorSizes",
    "LoopConfig",
    "LossWeights",
    "PaperConfig",
    "Preset",
    "Progress",
    "ablate",
    "assign_folds",
    "cross_validate",
    "fit_generator",
    "fit_key",
    "headway_quantiles",
    "load_generator",
    "scene_tracks",
    "shipped_generator",
    "split_for_fit",
]
