"""A policy of your own beside MOBIL and a shipped agent, on the same episodes, in the same table.

A policy is anything that writes ``action``: a network that reads ``observation``, or, as here, a
rule that reads the raw state. Run it with ``python examples/own_policy.py``. On the command line
the same class is ``ganlane evaluate 'agents=[mobil,random_legal,own_policy.LargestGap]'``
(with this folder on PYTHONPATH).
"""

from __future__ import annotations

import torch

import ganlane
from ganlane.agents.drivers import Driver
from ganlane.evaluation import text_table
from ganlane.keys import KEEP, LEFT, RIGHT
from ganlane.sim import Road, Stream, leader, safe_change
from ganlane.sim.dynamics import ego_scene


class LargestGap(Driver):
    """Changes to a lane whose gap ahead is at least ``better_m`` larger, if no driver there has to
    brake hard.
    """

    def __init__(self, road, stream=Stream.TRAIN, better_m=20.0):
        super().__init__(road, stream)
        self.better_m = better_m

    def act(self, vehicles, tensordict):
        """The action [N] of every row."""
        scene = ego_scene(vehicles, self.road)
        lane = scene.observers.target_lane.to(vehicles.x.dtype)
        best_gap = leader(scene, lane).gap.clamp_max(200.0) + self.better_m
        action = torch.full_like(scene.observers.target_lane, KEEP)
        for side, command in ((1.0, LEFT), (-1.0, RIGHT)):
            neighbour = self.road.clamp_lane(lane + side)
            gap = leader(scene, neighbour).gap.clamp_max(200.0)
            change = (neighbour != lane) & (gap > best_gap) & safe_change(scene, neighbour)
            action = torch.where(change, command, action)
            best_gap = torch.where(change, gap, best_gap)
        return action[:, 0]


def main(episodes=24, goal_m=500.0):
    """Evaluate four drivers on short episodes of the stream that is kept for reports."""
    mine = ganlane.Driver("largest_gap", LargestGap(Road(lanes=3), Stream.REPORT))
    drivers = ["mobil", "agent_idm", "random_legal", mine]
    print(
        text_table(ganlane.api.evaluate(drivers, ["idm_mobil"], episodes, goal_m=goal_m).to_dicts())
    )


if __name__ == "__main__":
    main()
