"""HighwayEnv: the simulator as a batched, stateless TorchRL environment. Raw state in, raw state and events out.

    action -> ego driver (target lane) -> [ traffic module -> ego dynamics -> events ] x substeps -> done flags

:mod:`~ganlane.env.highway` is what TorchRL sees: specs, reset, step. :mod:`~ganlane.env.decision` drives one
decision through its physics steps (:mod:`~ganlane.env.frozen` keeps what the traffic remembers of rows that end
on the way), :mod:`~ganlane.env.physics` says what happens to the ego in each of them, by the
:mod:`~ganlane.env.rules` of an episode. :mod:`~ganlane.env.state` says what the state consists of. Observation and
reward are transforms (:mod:`ganlane.transforms`); without them the environment shows its raw state and pays
nothing. The state travels in the TensorDict, so it can be copied, saved and branched.
"""

from ganlane.env.highway import HighwayEnv
from ganlane.parameters.episode import EpisodeParameters

__all__ = ["EpisodeParameters", "HighwayEnv"]
