"""A reward of your own: also penalise dangerous approaches behind the ego.

Section V.C counts dangerous approaches ahead of the ego. Those behind it (after the ego cut in) are
reported by the environment as ``events.soft_crash_behind``, without a penalty. This transform adds
one. Run it with ``python examples/own_reward.py``.
"""

from __future__ import annotations

import sys

from torchrl.envs import Compose, Transform, TransformedEnv

from ganlane import keys
from ganlane.agents.drivers import DRIVERS
from ganlane.env import EpisodeParameters, HighwayEnv
from ganlane.evaluation import run_episodes
from ganlane.sim import Road, Stream
from ganlane.traffic import IdmMobilTraffic
from ganlane.transforms import RewardTransform


class Courtesy(Transform):
    """Subtracts ``penalty`` from the reward for every onset of a soft crash behind the ego."""

    def __init__(self, penalty=5.0):
        super().__init__(in_keys=[keys.REWARD, keys.EVENTS], out_keys=[keys.REWARD])
        self.penalty = penalty

    def _call(self, next_tensordict):
        reward = next_tensordict.get(keys.REWARD)
        onsets = next_tensordict.get((keys.EVENTS, keys.SOFT_CRASH_BEHIND))
        return next_tensordict.set(keys.REWARD, reward - self.penalty * onsets.to(reward.dtype))

    def _reset(self, tensordict, tensordict_reset):
        return tensordict_reset


def main(goal_m="300"):
    """Returns of two drivers under the paper's reward and under the courteous one, on the same
    episodes.
    """
    road = Road(lanes=3)
    short = EpisodeParameters(goal_m=float(goal_m))
    for name in ("mobil", "random_legal"):
        driver = DRIVERS[name](road, Stream.REPORT)
        for title, transforms in (("paper", []), ("courteous", [Courtesy()])):
            traffic = IdmMobilTraffic(road, Stream.REPORT)
            env = HighwayEnv(traffic, num_envs=24, episode=short)
            env = TransformedEnv(env, Compose(RewardTransform(), *transforms))
            episodes = run_episodes(env, driver, range(24), seed=0)
            behind = episodes["soft_crash_behind"].sum()
            mean = episodes["reward"].mean()
            print(f"{name:>12} {title:>9}: mean return {mean:7.1f}, {behind} onsets behind")


if __name__ == "__main__":
    main(*sys.argv[1:])
