"""TEMP until the rooms are merged."""

from ganlane.settings.record import make, merged, plain, Record
from ganlane.settings.env import EnvConfig
from ganlane.settings.traffic import TrafficConfig
from ganlane.settings.observation import *

Option = object
K = {
    "env": EnvConfig,
    "traffic": TrafficConfig,
    "observation": ObservationConfig,
    "mask": MaskParameters,
    "reward": RewardParameters,
}
D = {
    "env": "highway",
    "traffic": "idm_mobil",
    "observation": "lane_view_overlap",
    "mask": "none",
    "reward": "paper",
}


def option(group, chosen, overrides=None, default=None):
    chosen = chosen if chosen is not None else (default or D[group])
    if isinstance(chosen, dict) and "name" not in chosen and "_target_" not in chosen:
        chosen = {"name": default or D[group], **chosen}
    if overrides:
        chosen = (
            {"name": chosen}
            if isinstance(chosen, str)
            else (plain(chosen) if isinstance(chosen, Record) else dict(chosen))
        )
        chosen = merged(chosen, overrides)
    return make(K[group], chosen, group)
