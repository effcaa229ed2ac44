"""Small environments and agents for tests of the training loop.

A toy road whose whole state is in the TensorDict.
"""

import os
import time

import torch
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    Unbounded,
)
from torchrl.envs import EnvBase

from ganlane.settings.env import EnvConfig
from ganlane.sim.random import draw_keys, episode_key, to_uniform

ACTIONS = 3
LIMIT = 8
ROAD = EnvConfig(vehicles=4, goal_m=60.0)
SMALL = {
    "hidden": (16, 16),
    "batch_size": 16,
    "warmup": 32,
    "capacity": 1000,
    "decisions_per_update": 8,
    "atoms": 11,
}


class ToyRoad(EnvBase):
    """Each decision one of three actions is right (+1), one crashes (-5), and one does nothing.

    The observation is a random draw [N, 4]: its largest of the first three is right, its smallest
    crashes. After 8 decisions the episode is a goal (+2) if the seed is even and times out
    otherwise.
    """

    def __init__(self, environments=8, seed=0):
        super().__init__(batch_size=[environments])
        self.seed_number = seed
        shape = (environments,)
        flag = Binary(shape=(*shape, 1), dtype=torch.bool)
        count = Unbounded(shape=shape, dtype=torch.int64)
        events = {
            name: flag.clone()
            for name in (
                "goal",
                "hard_crash",
                "out_of_road",
                "timeout",
                "scene_end",
            )
        }
        ego = {
            "distance": Unbounded(shape=shape),
            "lane_changes": count.clone(),
        }
        counters = {name: count.clone() for name in ("seed", "episode", "step")}
        self.observation_spec = Composite(
            {
                "observation": Bounded(0.0, 1.0, shape=(*shape, 4)),
                "events": Composite(events, shape=shape),
                "ego": Composite(ego, shape=shape),
                **counters,
            },
            shape=shape,
        )
        self.action_spec = Categorical(ACTIONS, shape=shape)
        self.reward_spec = Unbounded(shape=(*shape, 1))
        self.done_spec = Composite(
            {n: flag.clone() for n in ("done", "terminated", "truncated")},
            shape=shape,
        )

    def _observe(self, seed, episode, step):
        return to_uniform(draw_keys(episode_key(0, seed, episode), step, 1, [0, 1, 2, 3])).squeeze(
            1
        )

    def _reset(self, tensordict=None):
        rows = self.batch_size[0]
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            seed = torch.full((rows,), self.seed_number)
            episode = torch.arange(rows)
        else:
            # TorchRL hides everything but the mask from an automatic reset: the last step knows the
            # episodes.
            seed, episode = self.last
            episode = torch.where(mask.squeeze(-1), episode + rows, episode)
        begin = self.observation_spec.zero().update(self.full_done_spec.zero())
        begin.update({"seed": seed, "episode": episode})
        return begin.set(
            "observation",
            self._observe(seed, episode, begin["step"]),
        )

    def _step(self, tensordict):
        observation = tensordict["observation"]
        action = tensordict["action"]
        right = observation[:, :3].argmax(-1)
        wrong = observation[:, :3].argmin(-1)
        step = tensordict["step"] + 1
        crash = action == wrong
        over = (step >= LIMIT) & ~crash
        goal = over & (tensordict["seed"] % 2 == 0)
        timeout = over & ~goal
        reward = (action == right).float() - 5.0 * crash + 2.0 * goal
        seed, episode = self.last = (
            tensordict["seed"],
            tensordict["episode"],
        )
        after = self.observation_spec.zero().update(
            {"seed": seed, "episode": episode, "step": step}
        )
        flags = {
            "terminated": crash | goal,
            "truncated": timeout,
            "done": crash | over,
        }
        flags |= {
            ("events", "goal"): goal,
            ("events", "hard_crash"): crash,
            ("events", "timeout"): timeout,
        }
        for name, flag in flags.items():
            after.set(name, flag[:, None])
        after.set(
            ("ego", "distance"),
            tensordict["ego", "distance"] + 100.0,
        )
        after.set(
            ("ego", "lane_changes"),
            tensordict["ego", "lane_changes"] + (action > 0),
        )
        return after.set("reward", reward[:, None]).set(
            "observation", self._observe(seed, episode, step)
        )

    def _set_seed(self, seed):
        self.seed_number = seed


def same(first, second):
    """Whether two agents have the same weights, bit for bit."""
    pairs = zip(
        first.weights().values(),
        second.weights().values(),
        strict=True,
    )
    return all(torch.equal(one, other) for one, other in pairs)


def gone(group: int, within_s: float = 20.0) -> bool:
    """Whether a process group is empty soon.

    Who has ended counts until the system has taken note of it.
    """
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.1)
    return False
