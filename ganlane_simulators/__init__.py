"""Traffic driven by foreign simulators, to test agents among drivers that are not ours.

``traffic=sumo`` (:mod:`~ganlane_simulators.sumo`, its roads in
:mod:`~ganlane_simulators.sumo_roads`): SUMO's Krauss model and LC2013. ``traffic=highway_env``
(:mod:`~ganlane_simulators.highway_env`): HighwayEnv's IDM and MOBIL. The environment moves the ego
as always; there a stand-in drives in its place. Nothing in :mod:`ganlane` imports this package, and
the simulators are imported when a model is made, not before.
"""

from ganlane_simulators.highway_env import HighwayEnvTraffic
from ganlane_simulators.sumo import SumoTraffic

__all__ = ["HighwayEnvTraffic", "SumoTraffic"]
