"""TorchRL's own PPO on the highway, behind the action mask; its policy compared with MOBIL on the
same episodes.

``python examples/torchrl_ppo.py`` trains for 2 M decisions;
``python examples/torchrl_ppo.py 20000 4`` for some seconds, and compares on 4 episodes. The policy
is stored for ``ganlane benchmark outputs/torchrl/PPO_0.zip``.
"""

import sys

import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.modules import MLP, MaskedCategorical, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import ganlane
from ganlane.agents.stored_models import Reading, save_network
from ganlane.settings.observation import MaskParameters

STEPS = 64
EPOCHS = 4
MINIBATCH = 2048


def main(decisions="2000000", episodes="100", goal_m="5000", num_envs="256", seed="0"):
    """Collect, update, evaluate."""
    torch.manual_seed(int(seed))
    torch.set_num_threads(1)  # small networks: a second thread only costs
    options = {"mask": "safe", "goal_m": float(goal_m)}
    env = ganlane.make_env("idm_mobil", int(num_envs), seed=int(seed), **options)
    size = env.observation_spec["observation"].shape[-1]
    logits, value = (
        MLP(size, out, num_cells=[128, 128], activation_class=torch.nn.Tanh) for out in (3, 1)
    )
    actor = ProbabilisticActor(
        TensorDictModule(logits, ["observation"], ["logits"]),
        in_keys={"logits": "logits", "mask": "action_mask"},
        distribution_class=MaskedCategorical,
        return_log_prob=True,
    )
    critic = ValueOperator(value, in_keys=["observation"])
    advantage = GAE(gamma=0.98, lmbda=0.9, value_network=critic)
    loss = ClipPPOLoss(
        actor, critic, entropy_coeff=0.01, critic_coeff=0.5, normalize_advantage=True
    )
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
    frames = STEPS * int(num_envs)
    schedule = torch.optim.lr_scheduler.LinearLR(
        optimiser, 1.0, 0.0, max(1, int(decisions) // frames)
    )
    wanted = [
        "observation",
        "action",
        "action_mask",
        "action_log_prob",
        "advantage",
        "value_target",
        "state_value",
    ]
    batches = {"frames_per_batch": frames, "total_frames": int(decisions)}
    for batch in Collector(env, actor, **batches, auto_register_policy_transforms=False):
        with torch.no_grad():
            advantage(batch)
        data = batch.select(*wanted).reshape(-1)
        for _ in range(EPOCHS):
            for rows in torch.randperm(frames).split(MINIBATCH):
                losses = loss(data[rows])
                sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
                torch.nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimiser.step()
                optimiser.zero_grad()
        schedule.step()
    print(f"reward per decision {batch['next', 'reward'].mean():.2f}")
    reading = Reading(mask=MaskParameters("safe"))
    save_network(f"outputs/torchrl/PPO_{seed}.zip", logits, reading)
    drivers = [ganlane.Driver("torchrl_ppo", actor), "mobil"]
    table = ganlane.api.evaluate(drivers, ["idm_mobil"], int(episodes), **options)
    print(table.select("agent", "episodes", "goal", "hard_crash", "mean_reward"))


if __name__ == "__main__":
    main(*sys.argv[1:])
