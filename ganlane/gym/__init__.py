"""The highway for gymnasium: one environment, and a batch behind gymnasium's vector interface.

::

    import gymnasium
    import ganlane

    env = gymnasium.make("ganlane/Highway-v0", traffic="gan", lanes=4)
    envs = gymnasium.make_vec("ganlane/Highway-v0", num_envs=64, traffic="gan")

Further ids (:data:`ENV_IDS`) have other traffic: ``ganlane/HighwayDense-v0``,
``ganlane/HighwayGAN-v0``, ... Importing ganlane registers them (gymnasium 1 has no plugins);
``gymnasium.make("ganlane:ganlane/Highway-v0")`` imports and makes in one call.
:mod:`~ganlane.gym.single` and :mod:`~ganlane.gym.vector` are the two environments on top of
:mod:`~ganlane.gym.rows`. torch is imported where it is needed: for pictures
(:mod:`~ganlane.gym.rendering`), and for traffic that the native kernel does not drive
(:mod:`~ganlane.gym.tensor_rows`).
"""

from ganlane.runtime import ENV_ID, ENV_IDS

__all__ = ["ENV_ID", "ENV_IDS"]
