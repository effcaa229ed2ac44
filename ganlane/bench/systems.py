"""Systems as cases: bare physics, the whole environment, and HighwayEnv on the same road."""

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
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from ganlane import keys
from ganlane.bench.measure import COMPILED, NATIVE, Case, Runner, Suite
from ganlane.build import make_env, make_traffic
from ganlane.config.bench import BenchConfig
from ganlane.config.env import EnvConfig
from ganlane.config.traffic import TrafficConfig
from ganlane.env import HighwayEnv
from ganlane.env.highway import native_decision, threads_for
from ganlane.env.physics import run_decision
from ganlane.parameters.observation import ObservationConfig, RewardParameters
from ganlane.sim.random import episode_key
from ganlane.sim.state import Vehicles

#: Random actions are drawn before the clock starts and used again after so many decisions.
_DRAWN = 64


@dataclass(frozen=True)
class Scenario:
    """Configuration of an environment except batch, device and mode; can be pickled."""

    env: EnvConfig
    traffic: TrafficConfig
    observation: ObservationConfig
    reward: RewardParameters
    seed: int = 0

    @classmethod
    def of(cls, config: BenchConfig, traffic: TrafficConfig | None = None) -> Scenario:
        """From the command's configuration; ``traffic`` replaces its traffic."""
        return cls(config.env, traffic or config.traffic, config.observation, config.reward, config.seed)

    def build(self, mode: str, device: str, batch: int) -> TransformedEnv:
        """The environment."""
        env = replace(self.env, compile=mode == COMPILED, kernel="native" if mode == NATIVE else "torch")
        traffic = make_traffic(self.traffic, env)
        return make_env(traffic, env, self.observation, self.reward, batch, self.seed, device)


def start_physics(scenario: Scenario, mode: str, device: str, batch: int) -> Runner:
    """Traffic, ego dynamics, soft crashes and collision test alone; every turn starts from the first scene.

    The ego keeps its lane, and goal and time-out are out of reach, so that in rule-driven traffic no episode ends and
    every step moves every environment.
    """
    if mode == NATIVE:
        return start_native_physics(scenario, batch)
    env = scenario.build(mode, device, batch)
    state, base = env.reset(), env.base_env
    substeps = base.rules.episode.substeps()

    def run(decisions: int) -> int:
        _, step = bare_steps(base, state, decisions * substeps)
        return int((step - state.get(keys.STEP)).sum())

    return run


def start_native_physics(scenario: Scenario, batch: int) -> Runner:
    """The kernel alone, on the tensors of :func:`start_physics`."""
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
    """``steps`` physics steps from ``state`` as one long decision: the vehicles, and the counter of steps [N].

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
    """Steps a TorchRL environment with automatic resets; each turn continues where the last one ended.

    Physics steps are counted as they are simulated: an episode that ends within a decision is not simulated further,
    and one that leaves the road not at all.

    Args:
        env: what is stepped.
        actions: of consecutive decisions, used again from the first one on, [decisions, N].
    """

    def __init__(self, env: Any, actions: Tensor) -> None:
        self.env, self.actions = env, actions.to(env.device).unbind(0)
        self.state = env.reset()
        self.decisions = 0

    def __call__(self, decisions: int) -> int:
        """Drive; the physics steps."""
        simulated = torch.zeros((), dtype=torch.int64, device=self.env.device)
        with threads_for(self.env):
            for _ in range(decisions):
                self.decisions += 1
                self.state.set(keys.ACTION, self.actions[self.decisions % len(self.actions)])
                before, self.state = self.env.step_and_maybe_reset(self.state)
                simulated += (before["next", keys.STEP] - before[keys.STEP]).sum()
        return int(simulated)


def start_environment(scenario: Scenario, mode: str, device: str, batch: int) -> Runner:
    """The environment with observation, reward and automatic resets, driven by uniformly random actions."""
    generator = torch.Generator().manual_seed(scenario.seed)
    actions = torch.randint(3, (_DRAWN, batch), generator=generator)
    return EnvironmentRunner(scenario.build(mode, device, batch), actions)


class GymnasiumRunner:
    """``gymnasium.make_vec`` (with one environment ``gymnasium.make``), random actions, resets where episodes end."""

    def __init__(self, scenario: Scenario, mode: str, device: str, batch: int) -> None:
        options: dict[str, Any] = {"traffic": scenario.traffic, "env": replace(scenario.env, kernel=mode)}
        options |= {"observation": scenario.observation, "reward": scenario.reward, "seed": scenario.seed}
        self.batch, self.actions = batch, np.random.default_rng(scenario.seed).integers(3, size=(_DRAWN, batch))
        self.env: Any = (
            gymnasium.make("ganlane/Highway-v0", disable_env_checker=True, **options)
            if batch == 1
            else gymnasium.make_vec("ganlane/Highway-v0", batch, **options)
        )
        self.env.reset()
        self.decisions = 0
        self.time_s = np.zeros(batch)

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
                driven_s += info["time_s"] - float(self.time_s[0])
                self.time_s[0] = info["time_s"]
                if terminated or truncated:
                    self.env.reset()
                    self.time_s[0] = 0.0
        return round(driven_s / keys.PHYSICS_STEP_S)


def installed_version(package: str) -> str | None:
    """Version of a package; None if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def highway_env_settings(env: EnvConfig) -> dict[str, Any]:
    """``config`` of ``highway-v0`` for the same road; what is not named here keeps HighwayEnv's default.

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
    """``highway-v0`` without rendering and gymnasium's checks: random actions, a reset after every end."""

    def __init__(self, settings: dict[str, Any], seed: int) -> None:
        import highway_env

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # In some releases the import registers the environments, in others this function; both do no harm.
            getattr(highway_env, "register_highway_envs", lambda: None)()
            made = gymnasium.make("highway-v0", config=settings, disable_env_checker=True)
        self.env: Any = made.unwrapped
        self.env.reset(seed=seed)
        self.random = np.random.default_rng(seed)
        self.steps_per_decision = int(settings["simulation_frequency"] // settings["policy_frequency"])

    def __call__(self, decisions: int) -> int:
        """Drive; the physics steps."""
        for action in self.random.integers(self.env.action_space.n, size=decisions):
            _, _, terminated, truncated, _ = self.env.step(int(action))
            if terminated or truncated:
                self.env.reset()
        return decisions * self.steps_per_decision


def start_envpool(env: EnvConfig, batch: int, threads: int, seed: int) -> Runner:
    """HighwayEnv in EnvPool's C++: random actions; an episode that has ended begins anew in the next step."""
    import envpool

    settings = highway_env_settings(env)
    for each in ("observation", "action"):
        del settings[each]
    # Its rates are whole numbers.
    settings |= {"policy_frequency": max(1, round(1 / env.decision_period_s)), "duration": round(env.timeout_s)}
    settings |= {"max_episode_steps": round(env.timeout_s / env.decision_period_s), "seed": seed}
    made = envpool.make_gymnasium("Highway-v0", num_envs=batch, num_threads=min(threads, batch), **settings)
    made.reset()
    actions = cycle(np.random.default_rng(seed).integers(5, size=(_DRAWN, batch)).astype(np.int32))
    steps = batch * env.episode_parameters().substeps()

    def run(decisions: int) -> int:
        for action in islice(actions, decisions):
            made.step(action)
        return decisions * steps

    return run


def highway_env_case(suite: Suite) -> Case:
    """HighwayEnv on the suite's road; it does not use torch, so one thread is all it has."""
    config = suite.config
    labels = suite.labels(
        f"HighwayEnv {installed_version('highway-env')}", "its IDM and MOBIL", "eager", 1, 1, dtype="float64"
    )
    return Case(labels, partial(HighwayEnvRunner, highway_env_settings(config.env), config.seed))
