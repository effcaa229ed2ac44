"""Traffic that a foreign simulator drives, for tests on drivers that nobody here has written.

:mod:`~ganlane.traffic.foreign.sumo` is SUMO (Krauss and LC2013), its roads and drivers in
:mod:`~ganlane.traffic.foreign.sumo_roads`; :mod:`~ganlane.traffic.foreign.highway_env` is HighwayEnv (IDM and MOBIL
as that package has them). The ego is moved by the environment as always; in the foreign simulator a stand-in drives
in its place. The packages are imported when a model is made, not before.
"""

from ganlane.traffic.foreign.highway_env import HighwayEnvTraffic
from ganlane.traffic.foreign.lorries import LorryScenes
from ganlane.traffic.foreign.sumo import SumoTraffic

__all__ = ["HighwayEnvTraffic", "LorryScenes", "SumoTraffic"]
