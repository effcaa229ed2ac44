"""Traffic driven by a foreign simulator, for tests with drivers that are not ours.

:mod:`~ganlane.traffic.foreign.sumo` is SUMO (Krauss and LC2013), its roads and drivers in
:mod:`~ganlane.traffic.foreign.sumo_roads`; :mod:`~ganlane.traffic.foreign.highway_env` is HighwayEnv (its IDM and
MOBIL). The ego is moved by the environment as always; in the foreign simulator a stand-in drives in its place. The
packages are imported when a model is made, not before.
"""

from ganlane.traffic.foreign.highway_env import HighwayEnvTraffic
from ganlane.traffic.foreign.sumo import LorryScenes, SumoTraffic

__all__ = ["HighwayEnvTraffic", "LorryScenes", "SumoTraffic"]
