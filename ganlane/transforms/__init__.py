"""TorchRL transforms of the environment: observation (Table III), reward (section V.C), sensor
errors, action mask.

Each reads TensorDict keys that :class:`ganlane.env.HighwayEnv` writes and adds its own. A transform
of your own is used in the same way::

    TransformedEnv(env, Compose(MyObservation(env), RewardTransform()))

:class:`SensorTransform`, before the observation, adds sensor errors to what the agent sees;
:class:`ActionMaskTransform` computes the allowed actions.
"""

from ganlane.transforms.mask import MASKS, ActionMaskTransform
from ganlane.transforms.observation import (
    OBSERVATIONS,
    ObservationTransform,
    SensorParameters,
    SensorTransform,
    observation_size,
)
from ganlane.transforms.reward import RewardParameters, RewardTransform

__all__ = [
    "MASKS",
    "OBSERVATIONS",
    "ActionMaskTransform",
    "ObservationTransform",
    "RewardParameters",
    "RewardTransform",
    "SensorParameters",
    "SensorTransform",
    "observation_size",
]
