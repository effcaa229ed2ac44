"""The highway for gymnasium: one environment, and a batch of them behind gymnasium's vector interface.

::

    import gymnasium
    import ganlane

    env = gymnasium.make("ganlane/Highway-v0", traffic="gan", lanes=4)
    envs = gymnasium.make_vec("ganlane/Highway-v0", num_envs=64, traffic="gan")

Further ids (:data:`ENV_IDS`) have other traffic: ``ganlane/HighwayDense-v0``, ``ganlane/HighwayGAN-v0``, ...
Importing ganlane registers them (gymnasium 1 has no plugins); ``gymnasium.make("ganlane:ganlane/Highway-v0")``
imports and makes in one call. :mod:`~ganlane.gym.single` and :mod:`~ganlane.gym.vector` are the two environments on
top of :mod:`~ganlane.gym.rows`; :mod:`~ganlane.gym.rendering` draws. torch is imported where it is needed: for
pictures, and for traffic that the native kernel does not drive.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from typing import Final

ENV_ID: Final = "ganlane/Highway-v0"
#: Id to the arguments that differ; reference scores are in docs/gymnasium.md. The registered specs have no
#: ``max_episode_steps``: gymnasium would cut all episodes there, whatever ``timeout_s`` and ``decision_period_s``
#: are. That of an environment that has been made has the limit that is true for it.
ENV_IDS: Final[dict[str, dict[str, str]]] = {
    ENV_ID: {},
    "ganlane/HighwayDense-v0": {"env": "dense"},
    "ganlane/HighwayGAN-v0": {"traffic": "gan"},
    "ganlane/HighwayGANCalibrated-v0": {"traffic": "gan_calibrated"},
}


def register_envs() -> None:
    """Register the environments with gymnasium, once; without gymnasium nothing happens."""
    try:
        import gymnasium
    except ModuleNotFoundError:  # the rest of the package works; 'ganlane doctor' says what is missing
        return
    for name, arguments in ENV_IDS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="ganlane.gym.single:HighwayGym",
                vector_entry_point="ganlane.gym.vector:HighwayVectorGym",
                kwargs=arguments,
            )


def has_display() -> bool:
    """Whether a window can be opened here: pygame is there and, but on Windows and macOS, a display is named."""
    if importlib.util.find_spec("pygame") is None:
        return False
    named = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    return sys.platform in ("win32", "darwin") or any(map(os.environ.get, named))
