"""Training runs from plain configs: one phase or two, each resumable; the second starts from the first's agent."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from torchrl.envs import EnvBase

from ganlane.agents import GreedyPolicy, Rainbow, read_agent, save_agent, transfer
from ganlane.agents.drivers import legal_actions
from ganlane.agents.network import load_parameters
from ganlane.build import make_env, make_road, make_traffic, observation_of, set_threads
from ganlane.config.collector import MultiCollectorConfig, RayCollectorConfig
from ganlane.config.traffic import TrafficConfig
from ganlane.config.train import TrainConfig
from ganlane.errors import UserError
from ganlane.evaluation import code_version, run_episodes
from ganlane.memory import keep_freed_memory
from ganlane.sim.random import Stream
from ganlane.training import TrainingConfig, TrainingResult, find_checkpoint, make_logs, train
from ganlane.training.collectors import MultiSource, RaySource, SingleSource, Source, Team
from ganlane.transforms import observation_size

#: The trained agent, in the folder of its phase; its presence says that the phase is over.
AGENT_FILE = "agent.safetensors"


@dataclass(frozen=True)
class Phase:
    """A stretch of training on one traffic: where its files go, what it starts from (None: random weights)."""

    name: str
    folder: Path
    traffic: TrafficConfig
    total_decisions: int
    init: str | None


def phases_of(config: TrainConfig, folder: Path) -> list[Phase]:
    """The phases that ``config`` asks for, in order."""
    main = Phase("train", folder, config.traffic, config.total_decisions, config.init.path)
    before = config.pretrain
    if before.total_decisions == 0 or before.traffic is None:
        return [main]
    first = Phase("pretrain", folder / "pretrain", before.traffic, before.total_decisions, config.init.path)
    return [first, Phase("train", folder, config.traffic, config.total_decisions, str(first.folder / AGENT_FILE))]


def run_phase(config: TrainConfig, phase: Phase, resume: str | Path | None = None) -> TrainingResult:
    """Train the agent of one phase and write its :data:`AGENT_FILE`, unless a signal stopped it early.

    Args:
        config: of the whole run.
        phase: which part of it.
        resume: checkpoint to go on from.

    Raises:
        UserError: the agent to start from, the weights of the traffic or the checkpoint do not fit.
    """
    agent = make_agent(config, trained=phase.init is not None)
    if phase.init is not None and resume is None:
        check_observation(phase.init, config)
        transfer(agent, phase.init)
    with closing(make_source(config, phase)) as source:
        result = train(
            source,
            agent,
            _rhythm(config, phase),
            phase.folder,
            evaluate=_selection(config, phase) if config.evaluate_every else None,
            logs=make_logs(config.logger, phase.folder, describe(config, phase)),
            metadata=describe(config, phase),
            resume=resume,
            identity=identity(config, phase),
        )
    if result.stopped_by is None:
        _keep(agent, config, phase, result)
    return result


def make_source(config: TrainConfig, phase: Phase) -> Source:
    """Where the steps of a phase come from: ``collector=single``, ``multi`` or ``ray``.

    Raises:
        UserError: the environments cannot be made, or Ray is not installed.
    """
    collector = config.collector
    if not isinstance(collector, MultiCollectorConfig):
        return SingleSource(training_env(config, phase, collector.num_envs, device=config.device))
    training_env(config, phase, 1)  # a mistake shows here, before there are workers
    team = Team(collector.workers, collector.num_envs, collector.weights_every)
    if isinstance(collector, RayCollectorConfig):
        return RaySource(partial(worker_env, config, phase), team, collector.address)
    return MultiSource(partial(worker_env, config, phase), team)


def training_env(
    config: TrainConfig, phase: Phase, rows: int, first_episode: int = 0, device: str = "cpu"
) -> EnvBase:
    """``rows`` environments of the training stream; row i begins with episode ``first_episode + i``."""
    traffic = make_traffic(phase.traffic, config.env, Stream.TRAIN)
    return make_env(traffic, config.env, config.observation, config.reward, rows, config.seed, device, first_episode)


def worker_env(config: TrainConfig, phase: Phase, rows: int, first_episode: int) -> EnvBase:
    """The same in a process of its own, on its CPU."""
    set_threads(config.threads)
    keep_freed_memory()
    return training_env(config, phase, rows, first_episode)


def make_agent(config: TrainConfig, trained: bool = False) -> Rainbow:
    """A fresh agent for the observation of ``config``; one about to be given ``trained`` weights explores little."""
    rainbow = config.agent.rainbow()
    if trained:
        rainbow = replace(rainbow, epsilon_start=min(rainbow.epsilon_start, rainbow.epsilon))
    size = observation_size(config.observation.form, config.env.vehicles)
    legal = partial(legal_actions, road=make_road(config.env))
    return Rainbow(rainbow, size, seed=config.seed, device=config.device, legal=legal)


def check_observation(name: str, config: TrainConfig) -> None:
    """Refuse to start from an agent that was trained on another observation."""
    theirs = asdict(config.observation.read_by(observation_of(read_agent(name)[2])))
    ours = asdict(config.observation)
    for key, value in theirs.items():
        if value != ours[key]:
            option = f"observation={value}" if key == "form" else f"observation.{key}={value}"
            raise UserError(
                f"init.path={name}: this agent was trained with {option}, the run has {ours[key]}; "
                f"give {option} or start with init=none."
            )


def _rhythm(config: TrainConfig, phase: Phase) -> TrainingConfig:
    return TrainingConfig(
        total_decisions=phase.total_decisions,
        log_every=config.log_every,
        evaluate_every=config.evaluate_every,
        checkpoint_every_s=config.checkpoint_every_s,
        checkpoint_replay=config.checkpoint_replay,
        progress=config.logger.progress,
    )


def _selection(config: TrainConfig, phase: Phase) -> Callable[[GreedyPolicy], Mapping[str, float]]:
    """Drives the greedy policy through episodes of the stream that is kept for choosing among checkpoints."""
    traffic = make_traffic(phase.traffic, config.env, Stream.SELECT)
    rows = min(config.selection_episodes, config.evaluation.num_envs)
    env = make_env(traffic, config.env, config.observation, config.reward, rows, config.seed, config.device)

    def evaluate(policy: GreedyPolicy) -> dict[str, float]:
        table = run_episodes(env, policy, range(config.selection_episodes), config.seed)
        total = table.select("reward", "lane_changes", "distance_m", crashes=pl.col("reason") == "hard_crash").sum()
        reward, changes, distance_m, crashes = (float(value) for value in total.row(0))
        spread = float(np.std(table["reward"].to_numpy()))
        return {
            "mean_reward": reward / table.height,
            "standard_error": spread / math.sqrt(table.height),
            "crash_rate": crashes / table.height,
            "lane_changes_per_km": 1000.0 * changes / max(distance_m, 1.0),
        }

    return evaluate


def identity(config: TrainConfig, phase: Phase) -> dict[str, Any]:
    """What a resumed run must share with the one that was stopped."""
    return {
        "env": asdict(config.env),
        "traffic": asdict(phase.traffic),
        "observation": asdict(config.observation),
        "reward": asdict(config.reward),
        "collector": {name: value for name, value in asdict(config.collector).items() if name != "address"},
        "seed": config.seed,
    }


def length_of(agent: Path) -> dict[str, float]:
    """Decisions, updates and wall time of the finished phase that left ``agent``."""
    training = read_agent(agent)[2]["training"]
    return {name: training[name] for name in ("decisions", "updates", "wall_s")}


def describe(config: TrainConfig, phase: Phase) -> dict[str, Any]:
    """Metadata of the agent's files."""
    scale = {"range_m": config.observation.range_m, "speed_mps": config.observation.speed_mps}
    training = {"phase": phase.name, "init": phase.init, "seed": config.seed, "traffic": asdict(phase.traffic)}
    environment = {"vehicles": config.env.vehicles, "lanes": config.env.lanes}
    return {
        "observation": config.observation.form,
        "observation_scale": scale,
        "sensors": asdict(config.observation)["sensors"],
        "environment": environment,
        "env": asdict(config.env),
        "num_envs": config.collector.environments,
        "code": code_version(),
        "agent": asdict(config.agent),
        "reward": asdict(config.reward),
        "training": training,
    }


def _keep(agent: Rainbow, config: TrainConfig, phase: Phase, result: TrainingResult) -> None:
    """Write the agent of the phase: the best one where the run chose among several, else the last.

    Its metadata hold, beside the description, the length of the run and, for the best one, its figures on the
    stream kept for selection.
    """
    best, metadata = phase.folder / "checkpoints" / "best.safetensors", describe(config, phase)
    if result.best is not None and best.is_file():
        weights, _, known = read_agent(best)
        load_parameters(agent.network, weights)
        chosen = {name: value for name, value in known["training"].items() if name not in metadata["training"]}
        metadata["selected"] = {**chosen, "episodes": config.selection_episodes, "stream": "select"}
    metadata["training"] |= {"decisions": result.decisions, "updates": result.updates, "wall_s": result.wall_s}
    save_agent(phase.folder / AGENT_FILE, agent, metadata)


def checkpoint_of(phase: Phase, resume: str | None) -> Path | None:
    """Where ``phase`` goes on in a resumed run: its own checkpoint, if it had got so far as to write one."""
    if resume is None:
        return None
    own = phase.folder / "checkpoints" / "last.pt"
    return find_checkpoint(own, phase.folder) if own.is_file() else None
