"""TorchRL's stock DQN on the highway: nothing of ganlane's agent, only its environment.

Run it with ``python examples/stock_dqn.py``; a few seconds of training by default, more with
``python examples/stock_dqn.py 500000``.
"""

from __future__ import annotations

import sys

import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, TransformedEnv
from torchrl.modules import MLP, EGreedyModule, QValueActor
from torchrl.objectives import DQNLoss, SoftUpdate

from ganlane.env import HighwayEnv
from ganlane.sim import Road
from ganlane.traffic import IdmMobilTraffic
from ganlane.transforms import ObservationTransform, RewardTransform


def main(decisions=8_192, num_envs=64):
    """Collect, store, update."""
    torch.manual_seed(0)
    road = Road(lanes=3)
    env = HighwayEnv(IdmMobilTraffic(road), num_envs=num_envs)
    env = TransformedEnv(env, Compose(ObservationTransform(road, form="table3_lane_view"), RewardTransform()))
    network = MLP(in_features=env.observation_spec["observation"].shape[-1], out_features=3, num_cells=[128, 128])
    actor = QValueActor(network, in_keys=["observation"], spec=env.action_spec_unbatched, action_space="categorical")
    explore = EGreedyModule(env.action_spec_unbatched, eps_init=1.0, eps_end=0.05, annealing_num_steps=decisions // 2)
    loss = DQNLoss(actor, delay_value=True, action_space="categorical")
    loss.make_value_estimator(gamma=0.98)
    target = SoftUpdate(loss, eps=0.99)
    optimiser = torch.optim.Adam(loss.parameters(), lr=5e-4)
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(100_000), batch_size=256)
    policy = TensorDictSequential(actor, explore)
    wanted = ["observation", "action", ("next", "observation"), ("next", "reward")]
    wanted += [("next", "done"), ("next", "terminated")]
    batches = {"frames_per_batch": 8 * num_envs, "total_frames": decisions}
    for batch in Collector(env, policy, **batches, auto_register_policy_transforms=False):
        explore.step(batch.numel())
        replay.extend(batch.select(*wanted).reshape(-1))
        for _ in range(8):
            losses = loss(replay.sample())
            losses["loss"].backward()
            optimiser.step()
            optimiser.zero_grad()
            target.step()
    ego = batch["next", "ego"]
    print(f"loss {losses['loss'].item():.3f}, reward per decision {batch['next', 'reward'].mean():.2f}")
    print(f"last batch: {int(ego['started_change'].sum())} lane changes in {batch.numel()} decisions")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
