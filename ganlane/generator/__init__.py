"""The Social-GAN (section III of the paper): from recorded trajectories to a network that drives.

Read in this order:

- ``networks``: generator and discriminator; ``checkpoint``: their files;
- ``windows``: recordings to batches (segments of scenes; 9 positions observed, 8 to predict;
  k-means groups);
- ``closed_loop``: one step of each preset, in fitting and in simulation, and rollouts of whole
  scenes;
- ``forecasts``: of networks and IDM, and their scores;
- ``tasks``: what each preset fits, and the loop (``descent``: what all updates have in common);
  ``fit``: splits, one call, folds by scene.
"""

from ganlane.generator.checkpoint import FitResult, load_generator, load_human
from ganlane.generator.fit import (
    HELD_OUT,
    assign_folds,
    cross_validate,
    fit_generator,
    split_for_fit,
)
from ganlane.generator.networks import Discriminator, Generator
from ganlane.generator.tasks import Progress
from ganlane.settings.generated import ANCHOR, AnchorParameters
from ganlane.settings.generator import (
    CalibratedConfig,
    GeneratorSizes,
    LoopConfig,
    LossWeights,
    PaperConfig,
    Preset,
    shipped_generator,
)

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
    "assign_folds",
    "cross_validate",
    "fit_generator",
    "load_generator",
    "load_human",
    "shipped_generator",
    "split_for_fit",
]
