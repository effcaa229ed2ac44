"""The highway for gymnasium: one environment, and a batch of them behind gymnasium's vector
interface.

::

    import gymnasium
    import ganlane

    env = gymnasium.make("ganlane/Highway-v0", traffic="gan", lanes=4)
    envs = gymnasium.make_vec("ganlane/Highway-v0", num_envs=64, traffic="gan")

Further ids (:data:`ENV_IDS`) have other traffic: ``ganlane/HighwayDense-v0``,
``ganlane/HighwayGAN-v0``, ... Importing ganlane registers them (gymnasium 1 has no plugins);
``gymnasium.make("ganlane:ganlane/Highway-v0")`` imports and makes in one call.
:mod:`~ganlane.gym.single` and :mod:`~ganlane.gym.vector` are the two environments on top of
:mod:`~ganlane.gym.rows`. torch is imported where it is needed (:mod:`~ganlane.gym.tensor_rows`):
for pictures, and for traffic that the native kernel does not drive.
"""

from __future__ import annotations

import importlib.util
import os
import sys

from ganlane.runtime import ENV_ID, ENV_IDS

__all__ = ["ENV_ID", "ENV_IDS", "has_display"]


def has_display() -> bool:
    """Whether a window can be opened.

    Pygame is installed and, except on Windows and macOS, a display is set.
    """
    if importlib.util.find_spec("pygame") is None:
        return False
    variables = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    return sys.platform in ("win32", "darwin") or any(map(os.environ.get, variables))
