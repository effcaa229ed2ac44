"""The Social-GAN (section III of the paper): from recorded trajectories to a network that drives.

Read in this order. From recordings to batches: ``tracks`` (scenes as dense arrays), ``windows`` (9 positions
observed, 8 to predict), ``groups`` (k-means, kept by ``cache``), ``folds`` (who is fitted to, who chooses when to
stop, who is reported). The network: ``lstm`` (with projections that can be kept), ``pooling`` (over pairs of
vehicles), ``networks`` (generator and discriminator), ``losses``, ``metrics``. In closed loop: ``history`` and
``noise`` (what every driver carries along), ``paper`` and ``anchored`` (one step of each preset, the same in
fitting and in simulation). Fitting: ``schedule`` (how long, and how far an update goes), ``loop`` (early stopping,
resuming), ``fitting`` (the paper's preset, open loop), ``stretches``, ``rollouts``, ``traits``, ``rollout_metrics``
and ``calibrated`` (the other one, through whole scenes), ``fit`` (one call for both) and ``checkpoint``. Measuring:
``forecasts`` and ``baselines`` (courses of the same windows by everybody), ``scores``, ``reports`` (a fit and its
forecasts), ``cross_validation`` (k folds by scene), ``fold_tables`` (as text) and ``ablations`` (what each part is
worth).
"""

from ganlane.generator.ablations import ablate, ablation_table
from ganlane.generator.anchored import ANCHOR, AnchorParameters, DriverMemory, anchored_step
from ganlane.generator.calibrated import CalibratedConfig
from ganlane.generator.checkpoint import Preset, load_generator, save_generator, shipped_generator
from ganlane.generator.cross_validation import cross_validate
from ganlane.generator.fit import HELD_OUT, FitResult, fit_generator
from ganlane.generator.fitting import PaperConfig
from ganlane.generator.fold_tables import fold_tables
from ganlane.generator.folds import Split, assign_folds, split_for_fit, split_scenes
from ganlane.generator.groups import Groups, group_windows
from ganlane.generator.loop import Progress
from ganlane.generator.losses import LossWeights
from ganlane.generator.metrics import open_loop
from ganlane.generator.networks import Discriminator, Generator, GeneratorSizes
from ganlane.generator.paper import paper_step
from ganlane.generator.reports import fit_key
from ganlane.generator.rollout_metrics import rollout_metrics
from ganlane.generator.rollouts import rollout
from ganlane.generator.schedule import LoopConfig
from ganlane.generator.tracks import SceneTracks, scene_tracks
from ganlane.generator.traits import HEADWAY_QUANTILES_S, headway_quantiles
from ganlane.generator.windows import Windows, cut_windows

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
    "ablation_table",
    "anchored_step",
    "assign_folds",
    "cross_validate",
    "cut_windows",
    "fit_generator",
    "fit_key",
    "fold_tables",
    "group_windows",
    "headway_quantiles",
    "load_generator",
    "open_loop",
    "paper_step",
    "rollout",
    "rollout_metrics",
    "save_generator",
    "scene_tracks",
    "shipped_generator",
    "split_for_fit",
    "split_scenes",
]
