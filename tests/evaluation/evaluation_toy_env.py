"""A toy batched environment whose episodes are known beforehand, for the tests of the evaluation.

Episode ``e`` of seed ``s`` lasts ``length(s, e)`` decisions and ends for ``reason(e)``. Each
decision pays ``episode + 1`` for action 1 and 0.5 otherwise, drives 20 m and, on every third
decision, has a soft crash.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from ganlane import keys


def length(seed, episode):
    """Decisions of an episode."""
    return 3 + (7 * episode + seed) % 11


def reason(episode: int) -> str:
    """Why an episode ends."""
    return keys.END_EVENTS[episode % len(keys.END_EVENTS)]


def _nested(
    n: int,
    names: list[str],
    shape: tuple[int, ...],
    dtype: torch.dtype,
) -> Composite:
    return Composite({name: Unbounded((n, *shape), dtype=dtype) for name in names}, shape=(n,))


class ToyEnv(EnvBase):
    """N rows.

    An automatic reset goes on with episode + N, or with the ``next_episode`` that is asked for.
    """

    def __init__(self, n: int):
        super().__init__(batch_size=[n])
        self.reset_calls = 0
        ego = _nested(
            n,
            ["distance"],
            (),
            torch.float32,
        )
        ego.update(
            _nested(
                n,
                ["lane_changes", "decisions"],
                (),
                torch.int64,
            )
        )
        events = _nested(
            n,
            list(keys.END_EVENTS),
            (1,),
            torch.bool,
        )
        events.update(
            _nested(
                n,
                [keys.SOFT_CRASH, keys.SOFT_CRASH_BEHIND],
                (1,),
                torch.int64,
            )
        )
        counters = {
            name: Unbounded((n,), dtype=torch.int64)
            for name in (keys.SEED, keys.EPISODE, keys.STEP)
        }
        terms = _nested(
            n,
            ["speed", "goal"],
            (1,),
            torch.float32,
        )
        self.observation_spec = Composite(
            {
                **counters,
                "ego": ego,
                "events": events,
                "reward_terms": terms,
            },
            shape=(n,),
        )
        self.action_spec = Categorical(
            3,
            shape=(n,),
            dtype=torch.int64,
        )
        self.reward_spec = Unbounded((n, 1))

    def _set_seed(self, seed):
        return seed

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        next_episode: torch.Tensor | None = None,
        **kwargs,
    ) -> TensorDictBase:
        self.reset_calls += 1
        fresh = self.observation_spec.zero()
        if tensordict is not None and keys.SEED in tensordict:
            again = "_reset" in tensordict
            following = (
                tensordict[keys.EPISODE] + self.batch_size[0]
                if next_episode is None
                else next_episode
            )
            fresh[keys.SEED] = tensordict[keys.SEED].clone()
            fresh[keys.EPISODE] = following if again else tensordict[keys.EPISODE].clone()
        return fresh.update(self.full_done_spec.zero())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        seed, episode, step = (tensordict[name] for name in (keys.SEED, keys.EPISODE, keys.STEP))
        decisions = tensordict["ego", "decisions"] + 1
        chosen = tensordict["action"] == 1
        speed = torch.where(chosen, episode + 1.0, 0.5)[:, None]
        done = (decisions >= length(seed, episode))[:, None]
        which = (episode % len(keys.END_EVENTS))[:, None]
        ends = {name: done & (which == i) for i, name in enumerate(keys.END_EVENTS)}
        goal = 100.0 * ends["goal"]
        soft = (decisions % 3 == 0).long()[:, None]
        n, ego = self.batch_size, tensordict["ego"]
        driven = {"distance": ego["distance"] + 20.0, "lane_changes": ego["lane_changes"] + chosen}
        return TensorDict(
            {
                **{
                    keys.SEED: seed,
                    keys.EPISODE: episode,
                    keys.STEP: step + 10,
                },
                "ego": TensorDict({**driven, "decisions": decisions}, n),
                "events": TensorDict(
                    {
                        **ends,
                        "soft_crash": soft,
                        "soft_crash_behind": 2 * soft,
                    },
                    n,
                ),
                "reward_terms": TensorDict({"speed": speed, "goal": goal}, n),
                **{
                    "reward": speed + goal,
                    "done": done,
                    "terminated": done.clone(),
                },
            },
            n,
        )


def always(action: int) -> TensorDictModule:
    """A policy that always takes ``action``."""
    return TensorDictModule(
        lambda step: torch.full_like(step, action),
        in_keys=[keys.STEP],
        out_keys=["action"],
    )
