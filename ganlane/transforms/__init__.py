"""TorchRL transforms of the environment.

Observation (Table III), reward (section V.C), sensor errors and action mask. Each reads TensorDict
keys that :class:`ganlane.env.HighwayEnv` writes and adds its own. A transform of your own is used
in the same way::

    TransformedEnv(env, Compose(MyObservation(env), RewardTransform()))

:class:`SensorTransform`, before the observation, adds sensor errors to what the agent sees;
:class:`ActionMaskTransform` computes the allowed actions.
"""

from ganlane.transforms.mask import ActionMaskTransform
from ganlane.transforms.observation import OBSERVATIONS, ObservationTransform, observation_size
from ganlane.transforms.reward import RewardParameters, RewardTransform
from ganlane.transforms.sensors import SensorParameters, SensorTransform

__all__ = [
    "OBSERVATIONS",
    "ActionMaskTransform",
    "ObservationTransform",
    "RewardParameters",
    "RewardTransform",
    "SensorParameters",
    "SensorTransform",
    "observation_size",
]
