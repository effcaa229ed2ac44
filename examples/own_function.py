"""A plain function as an agent: it changes to the side that has more room ahead and nobody close
behind.

``python examples/own_function.py`` scores it on a fifth of the suite's episodes, 1.5 minutes of one
core; ``ganlane benchmark own_function:drive`` in this folder drives all of them.
"""

import sys

import numpy as np

import ganlane

RANGE_M = 200.0
#: Gaps ahead and behind, in the observation's numbers (lane_view_overlap, docs/agent.md).
LEFT, OWN, RIGHT = (3, 7), (11, 15), (19, 23)


def drive(observation):
    """Observations [N, 29] to actions [N]: 0 keep, 1 left, 2 right."""
    room = observation[:, OWN[0]]
    action = np.zeros(len(observation), dtype=int)
    for number, (ahead, behind), there in ((1, LEFT, 1), (2, RIGHT, 2)):
        is_better = observation[:, ahead] > room + 0.1
        is_free = observation[:, behind] > 25.0 / RANGE_M
        action[is_better & is_free & (observation[:, there] > 0.0)] = number
    # A change under way goes on by itself.
    action[observation[:, -1] != 0.0] = 0
    return action


def main(goal_m="5000"):
    """Score it."""
    suite = {"name": "shift-v1", "env": {"goal_m": float(goal_m)}}
    ganlane.benchmark(drive, suite=suite, quick=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
