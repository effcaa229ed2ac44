"""TorchRL transforms around the environment: what the agent sees (Table III) and what it is paid (V.C).

Each reads TensorDict keys that :class:`ganlane.env.HighwayEnv` writes and adds its own. A transform of your own
stands in the same place::

    TransformedEnv(env, Compose(MyObservation(env), RewardTransform()))

:class:`SensorTransform`, before the observation, puts sensor errors between the true state and what the agent sees.
:class:`ActionMaskTransform` says which actions are allowed.
"""

from ganlane.transforms.mask import MASKS, ActionMaskTransform
from ganlane.transforms.observation import OBSERVATIONS, ObservationTransform, largest_number, observation_size
from ganlane.transforms.reward import RewardParameters, RewardTransform
from ganlane.transforms.sensors import SensorParameters, SensorTransform

__all__ = [
    "MASKS",
    "OBSERVATIONS",
    "ActionMaskTransform",
    "ObservationTransform",
    "RewardParameters",
    "RewardTransform",
    "SensorParameters",
    "SensorTransform",
    "largest_number",
    "observation_size",
]
