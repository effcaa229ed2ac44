"""A policy of your own beside MOBIL, on the same episodes, in the same table.

A policy is anything that writes ``action``: a network that reads ``observation``, or, as here, a rule that reads the
raw state. Run it with ``python examples/own_policy.py``. On the command line the same class is
``python -m ganlane.evaluate 'agents=[mobil,random_legal,own_policy.LargestGap]'`` (with this folder on PYTHONPATH).
"""

from __future__ import annotations

import polars as pl
import torch
from torchrl.envs import TransformedEnv

from ganlane.agents.drivers import DRIVERS, Driver
from ganlane.env import EpisodeParameters, HighwayEnv
from ganlane.evaluation import evaluation_rows, run_episodes, text_table
from ganlane.keys import KEEP, LEFT, RIGHT
from ganlane.sim import Road, Stream, leader, safe_change
from ganlane.sim.ego import ego_scene
from ganlane.traffic import IdmMobilTraffic
from ganlane.transforms import RewardTransform


class LargestGap(Driver):
    """Goes where the gap ahead is at least ``better_m`` larger, if nobody there has to brake hard."""

    def __init__(self, road, stream=Stream.TRAIN, better_m=20.0):
        super().__init__(road, stream)
        self.better_m = better_m

    def act(self, vehicles, tensordict):
        """The action [N] of every row."""
        scene = ego_scene(vehicles, self.road)
        lane = scene.observers.target_lane.to(vehicles.x.dtype)
        wanted = leader(scene, lane).gap.clamp_max(200.0) + self.better_m
        action = torch.full_like(scene.observers.target_lane, KEEP)
        for side, command in ((1.0, LEFT), (-1.0, RIGHT)):
            there = self.road.clamp_lane(lane + side)
            gap = leader(scene, there).gap.clamp_max(200.0)
            goes = (there != lane) & (gap > wanted) & safe_change(scene, there)
            action = torch.where(goes, command, action)
            wanted = torch.where(goes, gap, wanted)
        return action[:, 0]


def main():
    """Evaluate four drivers on 24 short episodes of the stream that is kept for reports."""
    road, stream = Road(lanes=3), Stream.REPORT
    drivers = {name: DRIVERS[name](road, stream) for name in ("mobil", "keep_lane", "random_legal")}
    drivers["largest_gap"] = LargestGap(road, stream)
    env = HighwayEnv(
        IdmMobilTraffic(road, stream), num_envs=24, episode=EpisodeParameters(goal_m=500.0), stream=stream
    )
    env = TransformedEnv(env, RewardTransform())
    frames = [
        run_episodes(env, driver, range(24), seed=0).with_columns(agent=pl.lit(name), traffic=pl.lit("idm_mobil"))
        for name, driver in drivers.items()
    ]
    print(text_table(evaluation_rows(pl.concat(frames))))


if __name__ == "__main__":
    main()
