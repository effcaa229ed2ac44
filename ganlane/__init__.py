"""ganlane: reinforcement learning for highway driving in traffic that behaves like people.

::

    import gymnasium
    import ganlane

    # one highway, a batch of them, and the same for TorchRL
    env = gymnasium.make("ganlane/Highway-v0", traffic="gan")
    envs = gymnasium.make_vec("ganlane/Highway-v0", num_envs=64, traffic="gan")
    env = ganlane.make_env(traffic="gan", num_envs=256)
    # one score for a policy of your own, on the same episodes as everybody's
    run = ganlane.benchmark(my_function)
    # agents on traffics, as a data frame
    table = ganlane.api.evaluate(agents=["mobil", "agent_idm"], traffics=["gan"])

Imports run one way: ``data``, ``sim`` <- ``generator`` <- ``traffic`` <- ``env`` <- ``transforms``
<- ``agents`` <- ``evaluation`` <- ``view`` <- ``config`` <- ``build`` <- ``training`` <- ``suite``
<- ``api`` <- ``gym`` <- ``commands``. Below all of them are ``keys`` (every TensorDict key),
``errors``, ``files`` and ``runtime``.
"""

from __future__ import annotations

import importlib
import os
import sys
from typing import TYPE_CHECKING, Any

from ganlane._version import __version__
from ganlane.runtime import check_process, register_envs

if TYPE_CHECKING:  # for type checkers and editors, which do not run __getattr__
    from ganlane import api as api
    from ganlane.api import Driver as Driver
    from ganlane.api import benchmark as benchmark
    from ganlane.api import load_agent as load_agent
    from ganlane.api import make_env as make_env
    from ganlane.env import EpisodeParameters as EpisodeParameters
    from ganlane.env import HighwayEnv as HighwayEnv
    from ganlane.errors import UserError as UserError
    from ganlane.sim import Road as Road
    from ganlane.sim import Stream as Stream
    from ganlane.traffic import IdmMobilTraffic as IdmMobilTraffic
    from ganlane.traffic import IdmTraffic as IdmTraffic
    from ganlane.traffic import TrafficModule as TrafficModule
    from ganlane.transforms import ObservationTransform as ObservationTransform
    from ganlane.transforms import RewardParameters as RewardParameters
    from ganlane.transforms import RewardTransform as RewardTransform
    from ganlane.transforms import SensorParameters as SensorParameters
    from ganlane.transforms import SensorTransform as SensorTransform

_NAMES = {
    "api": "Driver benchmark load_agent make_env",
    "env": "EpisodeParameters HighwayEnv",
    "errors": "UserError",
    "sim": "Road Stream",
    "traffic": "IdmMobilTraffic IdmTraffic TrafficModule",
    "transforms": "ObservationTransform RewardParameters RewardTransform SensorParameters "
    "SensorTransform",
}
#: Module of each public name.
_MODULES = {name: f"ganlane.{module}" for module, names in _NAMES.items() for name in names.split()}
__all__ = ["__version__", "api", *_MODULES]


def __getattr__(name: str) -> Any:
    """Import a public name at its first use (PEP 562), so that ``import ganlane`` does not wait
    seconds for torch.
    """
    if name in ("api", *_MODULES):
        check_process()
    if name == "api":
        return importlib.import_module("ganlane.api")
    if name in _MODULES:
        return getattr(importlib.import_module(_MODULES[name]), name)
    raise AttributeError(
        f"module 'ganlane' has no attribute {name!r}; the commands' calls are in ganlane.api"
    )


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


# A command (``ganlane ...``, or ``python -m ganlane...``, where argv[0] is -m during this import)
# registers them only after checking its keys: importing gymnasium takes 0.2 s of the 0.7 s in which
# a mistyped key is reported.
if not sys.argv or os.path.splitext(os.path.basename(sys.argv[0]))[0] not in ("-m", "ganlane"):
    register_envs()
