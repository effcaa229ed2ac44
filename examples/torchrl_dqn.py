"""TorchRL's own DQN on the highway, behind the action mask: nothing of ganlane's agent, only its
environment.

``python examples/torchrl_dqn.py`` trains for 1 M decisions;
``python examples/torchrl_dqn.py 20000 4`` for some seconds, and compares on 4 episodes.
"""

import sys

import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import MLP, EGreedyModule, QValueActor
from torchrl.objectives import DQNLoss, SoftUpdate

import ganlane


def main(decisions="1000000", episodes="100", goal_m="5000", num_envs="64"):
    """Collect, store, update, evaluate."""
    torch.manual_seed(0)
    torch.set_num_threads(1)  # small networks: a second thread only costs
    options = {"mask": "safe", "goal_m": float(goal_m)}
    env = ganlane.make_env("idm_mobil", int(num_envs), **options)
    spec = env.action_spec_unbatched
    masked = {"action_mask_key": "action_mask"}
    network = MLP(env.observation_spec["observation"].shape[-1], 3, num_cells=[128, 128])
    actor = QValueActor(
        network, in_keys=["observation"], spec=spec, action_space="categorical", **masked
    )
    explore = EGreedyModule(
        spec, eps_init=1.0, eps_end=0.05, annealing_num_steps=int(decisions) // 2, **masked
    )
    loss = DQNLoss(actor, delay_value=True, action_space="categorical", loss_function="smooth_l1")
    loss.make_value_estimator(gamma=0.98)
    target = SoftUpdate(loss, eps=0.99)
    optimiser = torch.optim.Adam(loss.parameters(), lr=5e-4)
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(200_000), batch_size=512)
    policy = TensorDictSequential(actor, explore)
    wanted = [
        "observation",
        "action",
        "action_mask",
        ("next", "observation"),
        ("next", "action_mask"),
    ]
    wanted += [("next", "reward"), ("next", "done"), ("next", "terminated")]
    batches = {"frames_per_batch": 8 * int(num_envs), "total_frames": int(decisions)}
    for batch in Collector(env, policy, **batches, auto_register_policy_transforms=False):
        explore.step(batch.numel())
        replay.extend(batch.select(*wanted).reshape(-1))
        for _ in range(4):
            losses = loss(replay.sample())
            losses["loss"].backward()
            optimiser.step()
            optimiser.zero_grad()
            target.step()
    paid = batch["next", "reward"].mean()
    print(f"loss {losses['loss'].item():.3f}, reward per decision {paid:.2f}")
    drivers = [ganlane.Driver("torchrl_dqn", actor), "mobil"]
    table = ganlane.api.evaluate(drivers, ["idm_mobil"], int(episodes), **options)
    print(table.select("agent", "episodes", "goal", "hard_crash", "mean_reward"))


if __name__ == "__main__":
    main(*sys.argv[1:])
