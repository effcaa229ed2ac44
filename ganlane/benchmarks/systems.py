"""The package's own systems as something to run: the bare physics, and the environment with all around it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from ganlane import keys
from ganlane.benchmarks.case import COMPILED, Runner
from ganlane.build import make_env, make_traffic
from ganlane.config.env import EnvConfig
from ganlane.config.traffic import TrafficConfig
from ganlane.env import HighwayEnv
from ganlane.env.decision import Decision
from ganlane.parameters.observation import ObservationConfig
from ganlane.parameters.reward import RewardParameters
from ganlane.sim.random import episode_key
from ganlane.sim.vehicles import Vehicles

#: Actions are drawn before the clock starts and used again after so many decisions.
_DRAWN = 64


@dataclass(frozen=True)
class Scenario:
    """All that makes an environment but its batch, device and mode."""

    env: EnvConfig
    traffic: TrafficConfig
    observation: ObservationConfig
    reward: RewardParameters
    seed: int = 0


def build(scenario: Scenario, mode: str, device: str, batch: int) -> TransformedEnv:
    """The environment of a scenario."""
    env = replace(scenario.env, compile=mode == COMPILED)
    traffic = make_traffic(scenario.traffic, env)
    return make_env(traffic, env, scenario.observation, scenario.reward, batch, scenario.seed, device)


def start_physics(scenario: Scenario, mode: str, device: str, batch: int) -> Runner:
    """Traffic, ego dynamics, soft crashes, collision test, and nothing around them; every turn from the first scene.

    The ego keeps its lane, and goal and time-out are out of reach, so that in rule-driven traffic no episode ends and
    every step moves every row.
    """
    env = build(scenario, mode, device, batch)
    state, base = env.reset(), env.base_env
    substeps = base.rules.episode.substeps()

    def run(decisions: int) -> int:
        _, step = bare_steps(base, state, decisions * substeps)
        return int((step - state.get(keys.STEP)).sum())

    return run


def bare_steps(env: HighwayEnv, state: TensorDictBase, steps: int) -> tuple[Vehicles, Tensor]:
    """``steps`` physics steps from ``state`` as one long decision: the vehicles, and the counter of steps [N].

    The length of the decision stands outside the rules, so that compiled graphs serve whatever it is.
    """
    rules = env.rules._replace(episode=replace(env.rules.episode, goal_m=1e9, timeout_s=1e9))
    vehicles, ego = Vehicles.of(state.get(keys.VEHICLES)), dict(state.get(keys.EGO).items())
    keep = torch.full_like(state.get(keys.STEP), keys.KEEP)
    start, _ = env.physics.begin(rules, keep, vehicles, ego, state.get(keys.STEP))
    key = episode_key(env.stream, state.get(keys.SEED), state.get(keys.EPISODE))
    at, _ = Decision(env.traffic, env.physics, rules).drive(state, start, key, substeps=steps)
    return at.vehicles, at.step


def start_environment(scenario: Scenario, mode: str, device: str, batch: int) -> Runner:
    """The TorchRL environment with observation, reward and automatic resets, driven by random actions.

    Physics steps are counted as they are simulated: an episode that ends within a decision is not simulated further,
    and one that leaves the road not at all.
    """
    return _RandomDriving(build(scenario, mode, device, batch), scenario.seed)


class _RandomDriving:
    """Goes on where the last turn ended; every action has the same probability."""

    def __init__(self, env: TransformedEnv, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        actions = torch.randint(3, (_DRAWN, env.batch_size[0]), generator=generator)
        self.env, self.actions = env, actions.to(env.device).unbind(0)
        self.state = env.reset()
        self.decisions = 0

    def __call__(self, decisions: int) -> int:
        simulated = torch.zeros((), dtype=torch.int64, device=self.env.device)
        for _ in range(decisions):
            self.state.set(keys.ACTION, self._next_action())
            before, self.state = self.env.step_and_maybe_reset(self.state)
            simulated += (before["next", keys.STEP] - before[keys.STEP]).sum()
        return int(simulated)

    def _next_action(self) -> Tensor:
        self.decisions += 1
        return self.actions[self.decisions % _DRAWN]


def first_state(scenario: Scenario, batch: int) -> TensorDictBase:
    """The state after a reset, observation included."""
    return build(scenario, "eager", "cpu", batch).reset()
