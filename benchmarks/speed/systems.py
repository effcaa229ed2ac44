"""What is measured, ready to run: the simulator, bare and whole, a training, and their peers.

The road is the paper's, with other numbers of vehicles and lanes where asked for.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from itertools import cycle
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor
from torchrl.envs import TransformedEnv

import ganlane
from benchmarks.speed.measure import Runner
from ganlane import keys
from ganlane.agents import Rainbow, RainbowConfig
from ganlane.agents.drivers import legal_actions
from ganlane.agents.replay import TRANSITION_KEYS
from ganlane.training import loop
from ganlane.training.checkpoint import TrainingState
from ganlane.transforms import observation_size

#: Random actions are drawn before the clock starts and used again after so many decisions.
DRAWN = 64
#: Physics steps in a decision of one second.
STEPS = round(1 / keys.PHYSICS_STEP_S)
OBSERVATION = "lane_view"
#: Of the episodes, of random actions and of the agents.
SEED = 0
#: HighwayEnv's action that keeps lane and speed.
THEIR_KEEP = 1
#: Its ``highway-v0`` ends an episode after so many seconds, as ours does.
TIMEOUT_S = 1000


@dataclass(frozen=True)
class Road:
    """An environment except for its batch and how it is computed; ``scene``: ``env=merge``..."""

    traffic: str = "idm_mobil"
    vehicles: int = 9
    lanes: int = 3
    scene: str = "highway"

    def with_scene(self, scene: str) -> Road:
        """The road of a scene, which sets vehicles and lanes itself."""
        env = ganlane.make_env(env=scene).base_env
        return replace(self, scene=scene, vehicles=env.vehicles, lanes=env.road.lanes)

    def keys_of(self, mode: str) -> dict[str, Any]:
        """Keywords of :func:`ganlane.make_env` and of ``gymnasium.make`` for a mode."""
        shared = {
            "traffic": self.traffic,
            "observation": OBSERVATION,
            "seed": SEED,
            "kernel": "native" if mode == "native" else "torch",
        }
        if self.scene != "highway":
            return {**shared, "env": self.scene}
        return {
            **shared,
            # The first scene grows with the vehicles, at Table II's density.
            "env": "highway" if self.vehicles <= 9 else "dense",
            "vehicles": self.vehicles,
            "lanes": self.lanes,
            # A road that does not empty; recorded vehicles go where they went, and the range of
            # recycling would crowd a longer scene.
            "recycle": self.traffic != "replay" and self.vehicles <= 9,
        }

    def make(self, mode: str, device: str, batch: int, **more: Any) -> TransformedEnv:
        """The environment."""
        return ganlane.make_env(num_envs=batch, device=device, **self.keys_of(mode), **more)


def start_physics(road: Road, mode: str, device: str, batch: int) -> Runner:
    """Decisions without observation, reward and resets; every turn starts from the first scene.

    The ego keeps its lane, and goal and time-out are out of reach, so that in rule-driven traffic
    no episode ends and every step moves every environment.
    """
    env = road.make(mode, device, batch, goal_m=1e5, timeout_s=1e6)
    first = env.reset()
    keep = torch.full((batch,), keys.KEEP, device=device)

    def run(decisions: int) -> int:
        simulated = 0
        with torch.inference_mode():
            # 20 km a thousand decisions at most: far from the goal.
            for begin in range(0, decisions, 1000):
                state = first
                for _ in range(min(1000, decisions - begin)):
                    # Past TorchRL's own part of a step, which `environment` has.
                    state = env.base_env._step(state.set(keys.ACTION, keep))
                simulated += int((state.get(keys.STEP) - first.get(keys.STEP)).sum())
        return simulated

    return run


def _stepping(env: Any, actions: Tensor) -> Runner:
    """Steps a TorchRL environment with automatic resets; a turn goes on where the last one ended.

    ``actions`` [decisions, N] are those of consecutive decisions, again and again. Physics steps
    are counted as simulated: an episode that ends within a decision is not simulated further, one
    that leaves the road not at all.
    """
    drawn = cycle(actions.to(env.device).unbind(0))
    state = env.reset()

    def run(decisions: int) -> int:
        nonlocal state
        simulated = torch.zeros((), dtype=torch.int64, device=env.device)
        with torch.inference_mode():
            for _ in range(decisions):
                state.set(keys.ACTION, next(drawn))
                before, state = env.step_and_maybe_reset(state)
                simulated += (before["next", keys.STEP] - before[keys.STEP]).sum()
        return int(simulated)

    return run


def start_environment(road: Road, mode: str, device: str, batch: int) -> Runner:
    """The environment with observation, reward and resets, driven by uniformly random actions."""
    generator = torch.Generator().manual_seed(SEED)
    actions = torch.randint(3, (DRAWN, batch), generator=generator)
    return _stepping(road.make(mode, device, batch), actions)


def start_traffic(road: Road, mode: str, device: str, batch: int) -> Runner:
    """The environment without observation and reward, its ego keeping its lane."""
    env = road.make(mode, device, batch).base_env
    return _stepping(env, torch.full((1, batch), keys.KEEP))


def start_gymnasium(road: Road, mode: str, device: str, batch: int, keep: bool = False) -> Runner:
    """``gymnasium.make_vec`` (for one environment ``gymnasium.make``), with resets.

    Random actions, or with ``keep`` the lane is kept to the goal: episodes of 250 decisions in
    place of a dozen.
    """
    actions = np.random.default_rng(SEED).integers(3, size=(DRAWN, batch))
    if keep:
        actions[:] = keys.KEEP
    chosen = road.keys_of(mode)
    env: Any
    if batch == 1:
        env = gymnasium.make("ganlane/Highway-v0", disable_env_checker=True, **chosen)
    else:
        env = gymnasium.make_vec("ganlane/Highway-v0", batch, **chosen)
    env.reset()
    drawn = cycle(actions)
    time_s: Any = 0.0

    def run(decisions: int) -> int:
        nonlocal time_s
        driven_s = 0.0
        for _ in range(decisions):
            action = next(drawn)
            *_, terminated, truncated, info = env.step(int(action[0]) if batch == 1 else action)
            end_s = info["time_s"]
            if "_final_info" in info:  # of rows that were reset, the time at their ends
                end_s = np.where(info["_final_info"], info["final_info"]["time_s"], end_s)
            # Of a plain number NumPy's sum would take a tenth of a step's time.
            driven_s += end_s - time_s if batch == 1 else float(np.sum(end_s - time_s))
            time_s = info["time_s"]
            if batch == 1 and (terminated or truncated):
                env.reset()
                time_s = 0.0
        return round(driven_s / keys.PHYSICS_STEP_S)

    return run


# Training


def start_training(
    road: Road, mode: str, device: str, batch: int, config: RainbowConfig, stored: int
) -> Runner:
    """Decisions of ``batch`` environments and the updates that go with them; no logs.

    Driven transitions are stored until the agent is warm, and the same again until there are
    ``stored``: most of a long run has a full buffer, with all of its memory in use.
    """
    env = road.make(mode, device, batch)
    agent = Rainbow(
        replace(config, warmup=min(config.warmup, stored)),
        observation_size(OBSERVATION, road.vehicles),
        seed=SEED,
        device=device,
        legal=partial(legal_actions, road=env.base_env.road),
        compile=mode != "eager",
    )
    state = TrainingState(env, agent)
    while not agent.ready:
        loop.advance(state)
    transitions = agent.replay[:].select(*TRANSITION_KEYS, strict=False).clone()
    while (missing := stored - len(agent.replay)) > 0:
        agent.store(transitions[:missing])
    # As different as those of a run, in parts that the sampler takes at once.
    for rows in torch.arange(len(agent.replay), device=device).split(2**16):
        priority = torch.rand(rows.shape, generator=agent.generators["replay"], device=device)
        agent.replay.update_priority(rows, priority)

    def run(decisions: int) -> int:
        simulated = torch.zeros((), dtype=torch.int64, device=device)
        for _ in range(decisions):
            step = loop.advance(state)
            simulated += (step["next", keys.STEP] - step[keys.STEP]).sum()
        return int(simulated)

    return run


def start_without_ends(start: Callable[..., Runner], road: Road, *place: Any) -> Runner:
    """The same on a highway whose lanes go on, with as many vehicles and lanes."""
    return start(replace(road, scene="highway"), *place)


# Peers


def installed_version(package: str) -> str | None:
    """Version of a package; None if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _highway_settings(road: Road) -> dict[str, Any]:
    """``config`` of ``highway-v0`` for the same road; the rest keeps HighwayEnv's defaults.

    Its ``merge-v0`` and ``exit-v0`` have roads and vehicles of their own.
    """
    chosen = {"simulation_frequency": STEPS, "policy_frequency": 1}
    if road.scene == "highway":
        others = road.vehicles - 1
        chosen |= {"lanes_count": road.lanes, "vehicles_count": others, "duration": TIMEOUT_S}
    return chosen


def make_highway(road: Road) -> Any:
    """``highway-v0`` (``merge-v0``, ``exit-v0``) without rendering and gymnasium's checks."""
    import highway_env

    seen = {"observation": {"type": "Kinematics"}, "action": {"type": "DiscreteMetaAction"}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # In some releases the import registers the environments, in others this function.
        getattr(highway_env, "register_highway_envs", lambda: None)()
        config = _highway_settings(road) | seen
        env = gymnasium.make(f"{road.scene}-v0", config=config, disable_env_checker=True)
    env.unwrapped.reset(seed=SEED)
    return env.unwrapped


def start_highway(road: Road, keep: bool = False) -> Runner:
    """HighwayEnv: random actions, or the lane is kept; a reset after every end."""
    env = make_highway(road)
    random = np.random.default_rng(SEED)

    def run(decisions: int) -> int:
        for action in random.integers(env.action_space.n, size=decisions).tolist():
            _, _, terminated, truncated, _ = env.step(THEIR_KEEP if keep else action)
            if terminated or truncated:
                env.reset()
        return decisions * STEPS

    return run


def start_envpool(road: Road, batch: int, threads: int, keep: bool = False) -> Runner:
    """HighwayEnv in EnvPool's C++: as :func:`start_highway`, resets in the step after an end."""
    import envpool

    env = envpool.make_gymnasium(
        f"{road.scene.capitalize()}-v0",
        num_envs=batch,
        num_threads=min(threads, batch),
        max_episode_steps=TIMEOUT_S,
        seed=SEED,
        **_highway_settings(road),
    )
    env.reset()
    actions = np.random.default_rng(SEED).integers(5, size=(DRAWN, batch)).astype(np.int32)
    if keep:
        actions[:] = THEIR_KEEP

    def run(decisions: int) -> int:
        for decision in range(decisions):
            env.step(actions[decision % DRAWN])
        return decisions * batch * STEPS

    return run


def start_baseline(road: Road, config: RainbowConfig) -> Runner:
    """stable-baselines3's DQN on HighwayEnv, with the agent's network, batch and rate of updates.

    A call makes ``decisions_per_update`` decisions and an update.
    """
    from stable_baselines3 import DQN

    model = DQN(
        "MlpPolicy",
        make_highway(road),
        buffer_size=config.capacity,
        batch_size=config.batch_size,
        learning_starts=0,
        train_freq=config.decisions_per_update,
        gradient_steps=1,
        exploration_initial_eps=0.05,
        exploration_final_eps=0.05,
        policy_kwargs={"net_arch": list(config.hidden)},
        seed=SEED,
        device="cpu",
    )

    def run(calls: int) -> int:
        decisions = calls * config.decisions_per_update
        model.learn(decisions, log_interval=10**9, reset_num_timesteps=False)
        return decisions * STEPS

    return run
