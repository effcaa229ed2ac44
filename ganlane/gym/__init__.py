"""The highway for gymnasium: one environment, and a batch of them behind gymnasium's vector interface.

::

    import gymnasium
    import ganlane

    env = gymnasium.make("ganlane/Highway-v0", traffic="gan", lanes=4)
    envs = gymnasium.make_vec("ganlane/Highway-v0", num_envs=64, traffic="gan")

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


def register_envs() -> None:
    """Register the environments with gymnasium, once; without gymnasium nothing happens."""
    try:
        import gymnasium
    except ModuleNotFoundError:  # the rest of the package works; 'ganlane doctor' says what is missing
        return
    if ENV_ID not in gymnasium.registry:
        gymnasium.register(
            ENV_ID,
            entry_point="ganlane.gym.single:HighwayGym",
            vector_entry_point="ganlane.gym.vector:HighwayVectorGym",
        )


def has_display() -> bool:
    """Whether a window can be opened here: tkinter is there and, but on Windows and macOS, a display is named."""
    if importlib.util.find_spec("tkinter") is None:
        return False
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY"))
