"""HighwayEnv: the simulator as a batched, stateless TorchRL environment.

Raw state in, raw state and events out::

    action -> ego's target lane -> [ traffic -> ego's motion -> events ] x substeps -> done flags

:mod:`~ganlane.env.highway` has specs, reset and step, :mod:`~ganlane.env.physics` the physics steps
of one decision, :mod:`~ganlane.env.state` the fields. Observation and reward are transforms
(:mod:`ganlane.transforms`); without them the environment returns its raw state and no reward. The
state travels in the TensorDict, so it can be copied, saved and branched.
"""

from ganlane.env.highway import HighwayEnv, TransformedHighway
from ganlane.settings.episode import EpisodeParameters

__all__ = ["EpisodeParameters", "HighwayEnv", "TransformedHighway"]
