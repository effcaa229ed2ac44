"""The simulators that ganlane is held against, each as it is set up here."""

from __future__ import annotations

import importlib.metadata
import math
import platform
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import NamedTuple

from benchmarks.peers import highway_env_peer, sumo_peer
from benchmarks.peers.highway_env_peer import Distances
from benchmarks.peers.scene import LENGTH_M, Trace
from benchmarks.peers.schemes import Law, Scheme
from ganlane._version import __version__
from ganlane.errors import UserError


class Peer(NamedTuple):
    """A simulator as it is set up here: how it drives a scene, integrates, and reads IDM."""

    name: str
    module: str
    drive: Callable[..., Trace]
    scheme: Scheme
    law: Law


#: HighwayEnv neither floors the desired gap nor the speed, and sees nobody on an empty road.
_HIGHWAY_ENV = Law(floored=False, reverses=True, free_gap_m=math.inf)
_SUMO = Law(free_gap_m=math.inf)
PEERS = (
    Peer("HighwayEnv", "highway_env", highway_env_peer.drive, Scheme.EXPLICIT_EULER, _HIGHWAY_ENV),
    Peer(
        "HighwayEnv, centres",
        "highway_env",
        partial(highway_env_peer.drive, distances=Distances.CENTRES),
        Scheme.EXPLICIT_EULER,
        Law(LENGTH_M, floored=False, reverses=True, free_gap_m=math.inf),
    ),
    Peer("SUMO, ballistic", "libsumo", sumo_peer.drive, Scheme.BALLISTIC, _SUMO),
    Peer("SUMO, Euler", "libsumo", partial(sumo_peer.drive, ballistic=False), Scheme.SEMI_IMPLICIT_EULER, _SUMO),
)
PACKAGES = ("highway-env", "eclipse-sumo", "libsumo", "torch", "numpy")


def require_peers() -> None:
    """Say what to install where a peer is missing.

    Raises:
        UserError: HighwayEnv or SUMO is not installed.
    """
    missing = sorted({peer.module for peer in PEERS if find_spec(peer.module) is None})
    if missing:
        raise UserError(f"{', '.join(missing)}: not installed; pip install 'ganlane[bench]' brings the peers.")


def versions() -> dict[str, str]:
    """Versions of everything that the figures depend on."""
    own = {"ganlane": __version__, "python": platform.python_version()}
    return {**own, **{name: importlib.metadata.version(name) for name in PACKAGES}}
