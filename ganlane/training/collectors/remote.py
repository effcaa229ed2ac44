"""What runs in a worker: a policy that can be given new weights, an environment with episodes of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ganlane import keys
from ganlane.agents.network import NetworkConfig, QNetwork, load_parameters
from ganlane.agents.policy import ExploringPolicy, LegalActions
from ganlane.transforms.sensors import PERCEIVED, SENSORS

#: Makes the environments of a worker from their number and their first episode. It travels to the worker: a function
#: of a module, or a ``functools.partial`` of one.
MakeEnv = Callable[[int, int], EnvBase]

#: A worker's first episodes are so far from the next one's that no two workers ever drive the same.
EPISODES_PER_WORKER = 2**40

#: State of the simulation, most of a step's bytes: the workers need it, the loop does not.
_INNER = (keys.VEHICLES, keys.TRAFFIC, keys.ROAD, PERCEIVED, SENSORS)


class WorkerPolicy(ExploringPolicy):
    """The exploring policy of one worker: own noise and random actions, weights from outside."""

    def load(self, weights: Mapping[str, Tensor], epsilon: float) -> None:
        """Drive with ``weights`` (:func:`ganlane.agents.network.parameters_of`) and random share ``epsilon``."""
        load_parameters(self.network, weights)
        self.epsilon = epsilon


def make_policy(config: NetworkConfig, legal: LegalActions | None, seed: int) -> WorkerPolicy:
    """The policy of a worker, on its CPU; the first weights are still to come."""
    with torch.random.fork_rng(devices=[]):
        return WorkerPolicy(QNetwork(config), torch.Generator().manual_seed(seed), legal)


def noise_seed(seed: int, first_episode: int) -> int:
    """Seed of a worker's exploration: another one for every worker, and for every stretch of a resumed run."""
    return int(np.random.SeedSequence([seed, first_episode]).generate_state(1, np.uint64)[0] >> 1)


def read_by_loop(steps: TensorDictBase) -> TensorDictBase:
    """``steps`` without the state of the simulation."""
    return steps.exclude(*_INNER, *(("next", name) for name in _INNER))
