"""Systems as runners: the simulator bare and whole, behind gymnasium, in training.

And the peers on the same road.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from itertools import cycle, islice
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from ganlane import keys
from ganlane.agents import Rainbow, RainbowConfig
from ganlane.agents.drivers import legal_actions
from ganlane.agents.replay import TRANSITION_KEYS
from ganlane.bench.measure import COMPILED, EAGER, NATIVE, Runner
from ganlane.build import make_env, make_road, make_traffic
from ganlane.config.commands import BenchConfig
from ganlane.config.env import EnvConfig
from ganlane.config.traffic import TrafficConfig
from ganlane.env import HighwayEnv
from ganlane.env.highway import native_decision
from ganlane.env.physics import run_decision
from ganlane.parameters.observation import ObservationConfig, RewardParameters
from ganlane.sim.random import episode_key
from ganlane.sim.state import Vehicles
from ganlane.training import loop
from ganlane.training.checkpoint import TrainingState
from ganlane.transforms import observation_size

#: Random actions are drawn before the clock starts and used again after so many decisions.
_DRAWN = 64
#: Priorities set at once.
_CHUNK = 2**16


@dataclass(frozen=True)
class Scenario:
    """Configuration of an environment except batch, device and mode."""

    env: EnvConfig
    traffic: TrafficConfig
    observation: ObservationConfig
    reward: RewardParameters
    seed: int = 0

    @classmethod
    def of(cls, config: BenchConfig, traffic: TrafficConfig | None = None) -> Scenario:
        """From the command's configuration; ``traffic`` replaces its traffic."""
        return cls(
            config.env, traffic or config.traffic, config.observation, config.reward, config.seed
        )

    def build(self, mode: str, device: str, batch: int) -> TransformedEnv:
        """The environment."""
        env = replace(
            self.env, compile=mode == COMPILED, kernel="native" if mode == NATIVE else "torch"
        )
        return make_env(
            make_traffic(self.traffic, env),
            env,
            self.observation,
            self.reward,
            batch,
            self.seed,
            device,
        )


# The simulator


def start_physics(scenario: Scenario, mode: str, device: str, batch: int) -> Runner:
    """Traffic, ego dynamics, soft crashes and collision test alone; every turn starts from the
    first scene.

    The ego keeps its lane, and goal and time-out are out of reach, so that in rule-driven traffic
    no episode ends and every step moves every environment.
    """
    if mode == NATIVE:
        return _start_native_physics(scenario, batch)
    env = scenario.build(mode, device, batch)
    state, base = env.reset(), env.base_env
    substeps = base.rules.episode.substeps()

    def run(decisions: int) -> int:
        _, step = bare_steps(base, state, decisions * substeps)
        return int((step - state.get(keys.STEP)).sum())

    return run


def _start_native_physics(scenario: Scenario, batch: int) -> Runner:
    """The kernel alone."""
    endless = replace(scenario, env=replace(scenario.env, goal_m=1e9, timeout_s=1e8))
    env = endless.build(NATIVE, "cpu", batch)
    first, keep = env.reset(), torch.full((batch,), keys.KEEP)
    recycles = torch.ones(batch, dtype=torch.bool) if scenario.env.recycle else None

    def run(decisions: int) -> int:
        state = first
        for _ in range(decisions):
            state = native_decision(env.base_env.kernel, state, keep, recycles)
        return int((state.get(keys.STEP) - first.get(keys.STEP)).sum())

    return run


def bare_steps(env: HighwayEnv, state: TensorDictBase, steps: int) -> tuple[Vehicles, Tensor]:
    """``steps`` physics steps from ``state`` as one long decision: the vehicles, and the counter of
    steps [N].

    The rules keep their decision period, so that graphs compiled for one length serve all.
    """
    rules = env.rules._replace(episode=replace(env.rules.episode, goal_m=1e9, timeout_s=1e9))
    vehicles, ego = Vehicles.of(state.get(keys.VEHICLES)), dict(state.get(keys.EGO).items())
    keep = torch.full_like(state.get(keys.STEP), keys.KEEP)
    start, _ = env.physics.begin(rules, keep, vehicles, ego, state.get(keys.STEP))
    key = episode_key(env.stream, state.get(keys.SEED), state.get(keys.EPISODE))
    end, _ = run_decision(env.traffic, env.physics, rules, state, start, key, substeps=steps)
    return end.vehicles, end.step


class EnvironmentRunner:
    """Steps a TorchRL environment with automatic resets; each turn continues where the last one
    ended.

    ``actions`` [decisions, N] are those of consecutive decisions, again and again. Physics steps
    are counted as simulated: an episode that ends within a decision is not simulated further, one
    that leaves the road not at all.
    """

    def __init__(self, env: Any, actions: Tensor) -> None:
        self.env, self.actions = env, actions.to(env.device).unbind(0)
        self.state = env.reset()
        self.decisions = 0

    def __call__(self, decisions: int) -> int:
        """Drive; the physics steps."""
        simulated = torch.zeros((), dtype=torch.int64, device=self.env.device)
        for _ in range(decisions):
            self.decisions += 1
            self.state.set(keys.ACTION, self.actions[self.decisions % len(self.actions)])
            before, self.state = self.env.step_and_maybe_reset(self.state)
            simulated += (before["next", keys.STEP] - before[keys.STEP]).sum()
        return int(simulated)


def start_environment(scenario: Scenario, mode: str, device: str, batch: int) -> Runner:
    """The environment with observation, reward and automatic resets, driven by uniformly random
    actions.
    """
    actions = torch.randint(
        3, (_DRAWN, batch), generator=torch.Generator().manual_seed(scenario.seed)
    )
    return EnvironmentRunner(scenario.build(mode, device, batch), actions)


def start_traffic(scenario: Scenario, mode: str, batch: int) -> Runner:
    """The environment without observation and reward, its ego keeping its lane.

    Ended episodes start anew.
    """
    return EnvironmentRunner(
        scenario.build(mode, "cpu", batch).base_env, torch.full((1, batch), keys.KEEP)
    )


class GymnasiumRunner:
    """``gymnasium.make_vec`` (with one environment ``gymnasium.make``), random actions, resets
    where episodes end.
    """

    def __init__(self, scenario: Scenario, mode: str, device: str, batch: int) -> None:
        options: dict[str, Any] = {
            "traffic": scenario.traffic,
            "env": replace(scenario.env, kernel=mode),
        }
        options |= {
            "observation": scenario.observation,
            "reward": scenario.reward,
            "seed": scenario.seed,
        }
        self.batch, self.actions = (
            batch,
            np.random.default_rng(scenario.seed).integers(3, size=(_DRAWN, batch)),
        )
        self.env: Any = (
            gymnasium.make("ganlane/Highway-v0", disable_env_checker=True, **options)
            if batch == 1
            else gymnasium.make_vec("ganlane/Highway-v0", batch, **options)
        )
        self.env.reset()
        self.decisions = 0
        self.time_s: Any = 0.0

    def __call__(self, decisions: int) -> int:
        """Drive; the physics steps."""
        driven_s = 0.0
        for _ in range(decisions):
            self.decisions += 1
            actions = self.actions[self.decisions % _DRAWN]
            if self.batch > 1:
                *_, info = self.env.step(actions)
                after_s = info["time_s"]
                if "_final_info" in info:
                    after_s = np.where(info["_final_info"], info["final_info"]["time_s"], after_s)
                driven_s += float((after_s - self.time_s).sum())
                self.time_s = info["time_s"]
            else:
                *_, terminated, truncated, info = self.env.step(int(actions[0]))
                driven_s += info["time_s"] - self.time_s
                self.time_s = info["time_s"]
                if terminated or truncated:
                    self.env.reset()
                    self.time_s = 0.0
        return round(driven_s / keys.PHYSICS_STEP_S)


# Training


@dataclass(frozen=True)
class Training:
    """Scenario and agent of a training.

    ``stored`` transitions are in the buffer when the clock starts.
    """

    scenario: Scenario
    agent: RainbowConfig
    stored: int


def start_training(training: Training, mode: str, device: str, batch: int) -> Runner:
    """Decisions of ``batch`` environments and the updates that go with them.

    No logs, no checkpoints.
    """
    return partial(advance, filled_run(training, mode, device, batch)[0])


def filled_run(
    training: Training, mode: str, device: str, batch: int
) -> tuple[TrainingState, TransformedEnv]:
    """A run that learns from its next decision on, and the environment that it steps.

    Driven transitions are stored until the agent is warm, and the same again until there are
    ``training.stored``: most of a long run has a full buffer, with all of its memory in use.
    """
    env = training.scenario.build(mode, device, batch)
    run = TrainingState(env, make_agent(training, device, mode))
    while not run.agent.ready:
        run.agent.store(run.window.push(loop.collect(run)))
    repeat(run.agent, run.agent.replay[:].select(*TRANSITION_KEYS), training.stored)
    return run, env


def make_agent(training: Training, device: str = "cpu", mode: str = EAGER) -> Rainbow:
    """An agent with random weights, ready to learn as soon as ``stored`` transitions are there."""
    env, config = training.scenario.env, training.agent
    return Rainbow(
        replace(config, warmup=min(config.warmup, training.stored)),
        observation_size(training.scenario.observation.form, env.vehicles),
        seed=training.scenario.seed,
        device=device,
        legal=partial(legal_actions, road=make_road(env)),
        compile=mode != EAGER,
    )


def repeat(agent: Rainbow, transitions: TensorDict, stored: int) -> None:
    """Store ``transitions`` again and again until there are ``stored``.

    Priorities are uniform in 0 to 1.
    """
    known = transitions.clone()
    while (missing := stored - len(agent.replay)) > 0:
        agent.store(known[:missing])
    if agent.config.prioritised:
        for index in torch.arange(len(agent.replay), device=agent.device).split(_CHUNK):
            priority = torch.rand(
                index.shape, generator=agent.generators["replay"], device=agent.device
            )
            agent.replay.update_priority(index, priority)


@torch.inference_mode(False)  # in which cases are timed
def advance(run: TrainingState, decisions: int) -> int:
    """The body of :func:`ganlane.training.train`, so many times; the physics steps simulated."""
    simulated = torch.zeros((), dtype=torch.int64, device=run.agent.device)
    for _ in range(decisions):
        step = loop.advance(run)
        simulated += (step["next", keys.STEP] - step[keys.STEP]).sum()
    return int(simulated)


# Peers


def installed_version(package: str) -> str | None:
    """Version of a package; None if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _highway_env_settings(env: EnvConfig) -> dict[str, Any]:
    """``config`` of ``highway-v0`` for the same road; what is not named here keeps HighwayEnv's
    default.

    ``vehicles_count`` counts the others. Episodes end with a crash or after ``duration`` seconds.
    """
    return {
        "lanes_count": env.lanes,
        "vehicles_count": env.vehicles - 1,
        "simulation_frequency": round(1 / keys.PHYSICS_STEP_S),
        "policy_frequency": 1 / env.decision_period_s,
        "duration": env.timeout_s,
        "observation": {"type": "Kinematics"},
        "action": {"type": "DiscreteMetaAction"},
    }


class HighwayEnvRunner:
    """``highway-v0`` without rendering and gymnasium's checks.

    Random actions, a reset after every end.
    """

    def __init__(self, env: EnvConfig, seed: int) -> None:
        import highway_env

        settings = _highway_env_settings(env)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # In some releases the import registers the environments, in others this function; both
            # do no harm.
            getattr(highway_env, "register_highway_envs", lambda: None)()
            made = gymnasium.make("highway-v0", config=settings, disable_env_checker=True)
        self.env: Any = made.unwrapped
        self.env.reset(seed=seed)
        self.random = np.random.default_rng(seed)
        self.steps_per_decision = int(
            settings["simulation_frequency"] // settings["policy_frequency"]
        )

    def __call__(self, decisions: int) -> int:
        """Drive; the physics steps."""
        for action in self.random.integers(self.env.action_space.n, size=decisions):
            _, _, terminated, truncated, _ = self.env.step(int(action))
            if terminated or truncated:
                self.env.reset()
        return decisions * self.steps_per_decision


def start_envpool(env: EnvConfig, batch: int, threads: int, seed: int) -> Runner:
    """HighwayEnv in EnvPool's C++: random actions.

    An episode that has ended begins anew in the next step.
    """
    import envpool

    settings = _highway_env_settings(env)
    for each in ("observation", "action"):
        del settings[each]
    # Its rates are whole numbers.
    settings |= {
        "policy_frequency": max(1, round(1 / env.decision_period_s)),
        "duration": round(env.timeout_s),
    }
    settings |= {"max_episode_steps": round(env.timeout_s / env.decision_period_s), "seed": seed}
    made = envpool.make_gymnasium(
        "Highway-v0", num_envs=batch, num_threads=min(threads, batch), **settings
    )
    made.reset()
    actions = cycle(np.random.default_rng(seed).integers(5, size=(_DRAWN, batch)).astype(np.int32))
    steps = batch * env.episode_parameters().substeps()

    def run(decisions: int) -> int:
        for action in islice(actions, decisions):
            made.step(action)
        return decisions * steps

    return run


class BaselinesRunner:
    """stable-baselines3's DQN on ``highway-v0``, with the agent's network, batch and rate of
    updates.

    Its loop can be stopped at any decision: ``learn`` itself would end every turn with a whole
    rollout of ``decisions_per_update``. A batch is in the buffer when the clock starts.
    """

    @torch.random.fork_rng(devices=[])
    def __init__(self, env: EnvConfig, agent: RainbowConfig, seed: int) -> None:
        from stable_baselines3 import DQN

        road = HighwayEnvRunner(env, seed)
        self.steps_per_decision, self.every, self.pending = (
            road.steps_per_decision,
            agent.decisions_per_update,
            0,
        )
        self.model: Any = DQN(
            "MlpPolicy",
            road.env,
            buffer_size=agent.capacity,
            batch_size=agent.batch_size,
            train_freq=agent.decisions_per_update,
            gradient_steps=1,
            exploration_initial_eps=0.05,
            policy_kwargs={"net_arch": list(agent.hidden)},
            seed=seed,
            device="cpu",
        )
        _, self.callback = self.model._setup_learn(10**9)
        self._collect(agent.batch_size)

    @torch.inference_mode(False)
    def __call__(self, decisions: int) -> int:
        """Collect and learn; the physics steps."""
        missing = decisions
        while missing:
            taken = min(missing, self.every - self.pending)
            self._collect(taken)
            missing, self.pending = missing - taken, self.pending + taken
            if self.pending == self.every:
                self.model.train(gradient_steps=1, batch_size=self.model.batch_size)
                self.pending = 0
        return decisions * self.steps_per_decision

    def _collect(self, decisions: int) -> None:
        from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

        model, rollout = self.model, TrainFreq(decisions, TrainFrequencyUnit.STEP)
        model.collect_rollouts(
            model.env, self.callback, rollout, model.replay_buffer, learning_starts=0
        )
