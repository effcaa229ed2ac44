"""The phases of ``ganlane train``: one or two runs of the training loop.

The second starts from the agent of the first. :func:`phases_of` lists the phases of a config;
:func:`run_phase` makes environments and agent, trains, and writes the agent into the phase's
folder.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from torchrl.envs import EnvBase

from ganlane.agents import GreedyPolicy, Rainbow
from ganlane.agents.checkpoint import SHIPPED, read_agent, save_agent, warm_start
from ganlane.agents.drivers import legal_actions
from ganlane.agents.network import load_parameters
from ganlane.build import make_env, make_traffic, reading_of
from ganlane.errors import UserError
from ganlane.evaluation import code_version, run_episodes
from ganlane.evaluation.results import as_json, flat
from ganlane.settings.observation import ObservationConfig
from ganlane.settings.train import TrainConfig
from ganlane.sim.random import Stream
from ganlane.training.logs import make_logs
from ganlane.training.loop import Evaluate, TrainingResult, train
from ganlane.transforms import observation_size

#: File of the trained agent in the folder of its phase; it exists once the phase is finished.
AGENT_FILE = "agent.safetensors"


@dataclass(frozen=True)
class Phase:
    """Training on one traffic.

    Attributes:
        name: ``pretrain`` or ``train``.
        folder: of its files.
        config: of the run, with the traffic and the length of this phase.
        start: the agent to start from; None: random weights.
    """

    name: str
    folder: Path
    config: TrainConfig
    start: str | None


def phases_of(config: TrainConfig, folder: Path) -> list[Phase]:
    """The phases of ``config``, in order."""
    start = config.init.path
    pretrain = config.pretrain
    # One phase unless another is asked for.
    if pretrain.total_decisions == 0 or pretrain.traffic is None:
        return [Phase("train", folder, config, start)]

    # The second phase starts from the agent that the first one leaves.
    first_config = replace(
        config,
        traffic=pretrain.traffic,
        total_decisions=pretrain.total_decisions,
    )
    first = Phase("pretrain", folder / "pretrain", first_config, start)
    second = Phase("train", folder, config, str(first.folder / AGENT_FILE))
    return [first, second]


def length_if_finished(phase: Phase) -> dict[str, float] | None:
    """Decisions, updates and wall time of a finished first phase; None for any other phase.

    Raises:
        UserError: its length or traffic are not those asked for.
    """
    path = phase.folder / AGENT_FILE
    if phase.name != "pretrain" or not path.is_file():
        return None

    # The file is written at the end of the phase, with its length.
    _, _, metadata = read_agent(path)
    training = metadata["training"]
    done = training["decisions"]
    wanted = phase.config.total_decisions
    # The last step of all environments may go beyond it.
    if not wanted <= done < wanted + phase.config.num_envs:
        raise UserError(
            f"pretrain.total_decisions={wanted}: this phase is over, after {done} decisions; "
            "resume with the value that the run was started with."
        )
    if flat(training["traffic"]) != flat(as_json(phase.config.traffic)):
        raise UserError(
            "traffic@pretrain.traffic: this phase is over, on other traffic; resume with the same."
        )
    return {name: training[name] for name in ("decisions", "updates", "wall_s")}


def run_phase(phase: Phase, resume: str | Path | None = None) -> TrainingResult:
    """Train the agent of one phase and write its :data:`AGENT_FILE`.

    Nothing is written if a signal stopped it early.

    Args:
        phase: that is run.
        resume: checkpoint to continue from; None: from the start.

    Raises:
        UserError: the agent to start from, the weights of the traffic or the checkpoint do not fit.
    """
    config = phase.config
    agent = make_initial_agent(phase, resume is not None)
    metadata = describe(phase)
    make = env_maker(config, Stream.TRAIN)
    result = train(
        make(config.num_envs),
        agent,
        config,
        phase.folder,
        evaluate=make_selection(config) if config.evaluate_every else None,
        logs=make_logs(config.logger, phase.folder, metadata),
        metadata=metadata,
        resume=resume,
        identity=identity(config),
    )
    # A phase that was stopped is not over.
    if result.stopped_by is None:
        save_final_agent(agent, phase, metadata, result)
    return result


# --- the environments


def env_maker(config: TrainConfig, stream: Stream) -> Callable[..., EnvBase]:
    """What makes any number of environments, on the episodes of ``stream``."""
    traffic = make_traffic(config.traffic, config.env, stream)
    return partial(make_env, traffic, config)


def make_selection(config: TrainConfig) -> Evaluate:
    """A function that evaluates the greedy policy on episodes that are never trained on."""
    make = env_maker(config, Stream.SELECT)
    env = make(min(config.selection_episodes, config.evaluation.num_envs))
    # The same episodes in every call, so that figures can be compared.
    episodes = range(config.selection_episodes)

    def evaluate(policy: GreedyPolicy) -> dict[str, float]:
        # A row per episode.
        table = run_episodes(env, policy, episodes, config.seed, make_smaller=make)
        crashed = pl.col("reason") == "hard_crash"
        total = table.select("reward", "lane_changes", "distance_m", crashed).sum()
        reward, changes, distance_m, crashes = map(float, total.row(0))
        spread = float(np.std(table["reward"].to_numpy()))
        return {
            "mean_reward": reward / table.height,
            # Of the mean reward over the episodes.
            "standard_error": spread / math.sqrt(table.height),
            "crash_rate": crashes / table.height,
            # At least 1 m: all episodes may end at once.
            "lane_changes_per_km": 1000.0 * changes / max(distance_m, 1.0),
        }

    return evaluate


# --- the agent


def start_file(name: str) -> str:
    """The agent behind ``init.path``: a shipped one, a file, or that of a run's folder."""
    is_run = Path(name).is_dir() and name not in SHIPPED
    return str(Path(name) / AGENT_FILE) if is_run else name


def make_agent(phase: Phase) -> Rainbow:
    """A new agent; one that will get trained weights explores little."""
    config = phase.config
    actions = config.env.actions
    # A falling learning rate reaches its end with the phase.
    options = config.agent.for_phase(config.total_decisions)
    # Trained weights need no long phase of random actions.
    if phase.start is not None:
        epsilon_start = min(options.epsilon_start, options.epsilon)
        options = replace(options, epsilon_start=epsilon_start)

    size = observation_size(config.observation.form, config.env.vehicles, actions)
    legal = partial(legal_actions, road=config.env.road(), actions=actions)
    return Rainbow(
        options,
        size,
        len(actions.names),
        seed=config.seed,
        device=config.device,
        legal=legal,
        compile=config.compiles(),
    )


def make_initial_agent(phase: Phase, resumes: bool) -> Rainbow:
    """The initial agent of ``phase``; if it ``resumes``, one to be restored.

    The file that a resumed run started from may no longer exist.

    Raises:
        UserError: the agent to start from is missing, cannot be read, or does not fit.
    """
    agent = make_agent(phase)
    if phase.start is None or resumes:
        return agent

    name = start_file(phase.start)
    weights, network, metadata = read_agent(name)
    trained = reading_of(metadata).observation
    check_observation(name, trained, phase.config.observation)
    warm_start(agent, name, weights, network)
    return agent


def check_observation(
    name: str, trained: ObservationConfig, observation: ObservationConfig
) -> None:
    """Raise :class:`UserError` if the agent ``name`` was ``trained`` on another observation."""
    # What the trained agent reads of this observation, key by key.
    configured = asdict(observation)
    for key, value in asdict(observation.read_by(trained)).items():
        if value != configured[key]:
            option = f"observation={value}" if key == "form" else f"observation.{key}={value}"
            raise UserError(
                f"init.path={name}: this agent was trained with {option}, the run has "
                f"{configured[key]}; give {option} or start with init=none."
            )


def save_final_agent(
    agent: Rainbow, phase: Phase, metadata: Mapping[str, Any], result: TrainingResult
) -> None:
    """Write the agent of the phase: the best one by evaluation, or the last without evaluations.

    The metadata also hold the length of the run and, for the best agent, its figures on the
    selection stream.
    """
    training = metadata["training"]
    final = {**metadata, "training": {**training, **result.progress}}

    # The best agent replaces the last one.
    best = phase.folder / "checkpoints" / "best.safetensors"
    if result.best is not None and best.is_file():
        weights, _, saved = read_agent(best)
        load_parameters(agent.network, weights)
        # What the evaluation added to the metadata of the best agent.
        figures = {name: value for name, value in saved["training"].items() if name not in training}
        final["selected"] = {
            **figures,
            "episodes": phase.config.selection_episodes,
            "stream": "select",
        }

    save_agent(phase.folder / AGENT_FILE, agent, final)


# --- metadata


def identity(config: TrainConfig) -> dict[str, Any]:
    """The settings that a resumed run must share with the run that was stopped."""
    return {
        "env": as_json(config.env),
        "traffic": as_json(config.traffic),
        "observation": asdict(config.observation),
        "reward": asdict(config.reward),
        "mask": asdict(config.mask),
        "init": config.init.path,
        "num_envs": config.num_envs,
        "seed": config.seed,
    }


def describe(phase: Phase) -> dict[str, Any]:
    """Metadata of the agent's files."""
    config = phase.config
    return {
        "observation": config.observation.form,
        "observation_scale": asdict(config.observation.scale()),
        "mask": asdict(config.mask),
        "sensors": asdict(config.observation)["sensors"],
        "environment": {"vehicles": config.env.vehicles, "lanes": config.env.lanes},
        "env": as_json(config.env),
        "num_envs": config.num_envs,
        "code": code_version(),
        "agent": as_json(config.agent),
        "reward": asdict(config.reward),
        "training": {
            "phase": phase.name,
            "init": phase.start,
            "seed": config.seed,
            "traffic": as_json(config.traffic),
        },
    }
