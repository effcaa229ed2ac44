"""The Social-GAN (section III of the paper): from recorded trajectories to a network that drives.

Read in this order:

- recordings to batches: ``windows`` (9 positions observed, 8 to predict), ``splits``, ``groups`` (k-means),
  ``segments`` (of whole scenes);
- networks: ``layers``, ``networks`` (generator and discriminator), ``losses``;
- closed loop: ``closed_loop`` (one step of each preset, in fitting and in simulation), ``rollout`` (whole scenes);
- fitting: ``loop`` (early stopping, resuming), ``fit_paper``, ``fit_calibrated``, ``fit`` (one call), ``checkpoint``;
- measuring: ``forecasts`` (networks, IDM, baselines), ``scores``, ``cross_validation`` (folds by scene, ablations).
"""

from ganlane.generator.checkpoint import FitResult, Preset, load_generator, shipped_generator
from ganlane.generator.closed_loop import ANCHOR, AnchorParameters, DriverMemory, anchored_step, paper_step
from ganlane.generator.cross_validation import ablate, cross_validate
from ganlane.generator.fit import HELD_OUT, fit_generator, fit_key, preset_of
from ganlane.generator.groups import Groups, group_windows
from ganlane.generator.loop import Progress
from ganlane.generator.networks import Discriminator, Generator
from ganlane.generator.rollout import HEADWAY_QUANTILES_S, headway_quantiles
from ganlane.generator.scores import rollout_errors, window_errors
from ganlane.generator.splits import Split, assign_folds, split_for_fit, split_scenes
from ganlane.generator.windows import SceneTracks, Windows, cut_windows, scene_tracks
from ganlane.parameters.generator import CalibratedConfig, GeneratorSizes, LoopConfig, LossWeights, PaperConfig

__all__ = [
    "ANCHOR",
    "HEADWAY_QUANTILES_S",
    "HELD_OUT",
    "AnchorParameters",
    "CalibratedConfig",
    "Discriminator",
    "DriverMemory",
    "FitResult",
    "Generator",
    "GeneratorSizes",
    "Groups",
    "LoopConfig",
    "LossWeights",
    "PaperConfig",
    "Preset",
    "Progress",
    "SceneTracks",
    "Split",
    "Windows",
    "ablate",
    "anchored_step",
    "assign_folds",
    "cross_validate",
    "cut_windows",
    "fit_generator",
    "fit_key",
    "group_windows",
    "headway_quantiles",
    "load_generator",
    "paper_step",
    "preset_of",
    "rollout_errors",
    "scene_tracks",
    "shipped_generator",
    "split_for_fit",
    "split_scenes",
    "window_errors",
]
