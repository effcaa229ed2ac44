"""ganlane: reinforcement learning for highway driving in traffic that behaves like people.

::

    import gymnasium
    import ganlane

    env = gymnasium.make("ganlane/Highway-v0", traffic="gan")                   # one highway
    envs = gymnasium.make_vec("ganlane/Highway-v0", num_envs=64, traffic="gan")  # a batch of them
    env = ganlane.make_env(traffic="gan", num_envs=256)                          # the same for TorchRL
    table = ganlane.evaluate(agents=["mobil", "agent_idm"], traffics=["gan"])    # a data frame

The package reads from the bottom up, and imports run only downwards:

``data``, ``sim``  <-  ``generator``  <-  ``traffic``  <-  ``env``  <-  ``transforms``  <-  ``agents``  <-
``evaluation``  <-  ``training``  <-  ``view``  <-  ``config``  <-  entry points  <-  ``api``  <-  ``gym``.

Three small modules stand under all of them: ``keys`` (every TensorDict key, declared once), ``errors``
(a user's mistake, told in one sentence) and ``files`` (atomic writes and safe checkpoints).

Importing the package registers the gymnasium environments and loads nothing else: what is named here is imported
when it is first used.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from ganlane._version import __version__
from ganlane.gym import register_envs

if TYPE_CHECKING:
    from ganlane.api import (
        bench,
        evaluate,
        load_agent,
        make_env,
        prepare,
        realism,
        render,
        train,
        train_generator,
    )
    from ganlane.build import Driver
    from ganlane.env import EpisodeParameters, HighwayEnv
    from ganlane.errors import UserError
    from ganlane.sim import Road, Stream
    from ganlane.traffic import IdmMobilTraffic, IdmTraffic, TrafficModule
    from ganlane.transforms import (
        ObservationTransform,
        RewardParameters,
        RewardTransform,
        SensorParameters,
        SensorTransform,
    )

#: Where each name comes from.
_HOMES = {
    "ganlane.api": "bench evaluate load_agent make_env prepare realism render train train_generator",
    "ganlane.build": "Driver",
    "ganlane.env": "EpisodeParameters HighwayEnv",
    "ganlane.errors": "UserError",
    "ganlane.sim": "Road Stream",
    "ganlane.traffic": "IdmMobilTraffic IdmTraffic TrafficModule",
    "ganlane.transforms": "ObservationTransform RewardParameters RewardTransform SensorParameters SensorTransform",
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names.split()}

__all__ = [
    "Driver",
    "EpisodeParameters",
    "HighwayEnv",
    "IdmMobilTraffic",
    "IdmTraffic",
    "ObservationTransform",
    "RewardParameters",
    "RewardTransform",
    "Road",
    "SensorParameters",
    "SensorTransform",
    "Stream",
    "TrafficModule",
    "UserError",
    "__version__",
    "bench",
    "evaluate",
    "load_agent",
    "make_env",
    "prepare",
    "realism",
    "render",
    "train",
    "train_generator",
]


def __getattr__(name: str) -> Any:
    """A name of the package, imported now."""
    if name not in _HOME_OF:
        raise AttributeError(f"module 'ganlane' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    """What can be imported from here."""
    return sorted({*globals(), *_HOME_OF})


class _Package(ModuleType):
    """Keeps ``ganlane.evaluate`` the call of that name once the command's module ``ganlane.evaluate`` was imported.

    Importing a submodule makes it an attribute of its package, which would hide the call. The modules are reached
    by ``from ganlane.evaluate import ...``.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOME_OF and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
register_envs()
