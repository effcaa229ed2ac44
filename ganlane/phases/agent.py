"""The agent of a phase: made, checked against what it starts from, kept at the end."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from ganlane.agents import Rainbow, read_agent, save_agent
from ganlane.agents.drivers import legal_actions
from ganlane.agents.network import load_parameters
from ganlane.build import make_road
from ganlane.config.train import TrainConfig
from ganlane.errors import UserError
from ganlane.phases.description import describe
from ganlane.phases.phase import AGENT_FILE, Phase
from ganlane.phases.start import Start, give, read_start, with_support
from ganlane.training import TrainingResult
from ganlane.training.run import flat
from ganlane.transforms import observation_size


def make_agent(config: TrainConfig, phase: Phase) -> Rainbow:
    """A fresh agent for the observation of ``config``; one about to be given trained weights explores little."""
    rainbow = config.agent.for_phase(phase.total_decisions)
    if phase.init is not None:
        rainbow = replace(rainbow, epsilon_start=min(rainbow.epsilon_start, rainbow.epsilon))
    size = observation_size(config.observation.form, config.env.vehicles)
    legal = partial(legal_actions, road=make_road(config.env))
    return Rainbow(rainbow, size, seed=config.seed, device=config.device, legal=legal)


def begin(config: TrainConfig, phase: Phase, resume: str | Path | None) -> tuple[TrainConfig, Rainbow]:
    """The agent with which ``phase`` begins, or one ready to be restored; and ``config`` with the support it has.

    Raises:
        UserError: the agent to start from does not fit.
    """
    if phase.init is None:
        return config, make_agent(config, phase)
    if resume is not None:
        if config.init.support == "trained":  # that of the run itself: what it once started from may be gone
            config = with_support(config, read_start(str(resume), "resume"))
        return config, make_agent(config, phase)
    start = read_start(phase.init)
    check_observation(start, config)
    config = with_support(config, start)
    agent = make_agent(config, phase)
    # A second phase starts from the best agent of the first, whose moments are not kept.
    give(agent, start, moments=config.init.optimizer and phase.init == config.init.path)
    return config, agent


def check_observation(start: Start, config: TrainConfig) -> None:
    """Refuse to start from an agent that was trained on another observation."""
    theirs = asdict(config.observation.read_by(start.observation))
    ours = asdict(config.observation)
    for key, value in theirs.items():
        if value != ours[key]:
            option = f"observation={value}" if key == "form" else f"observation.{key}={value}"
            raise UserError(
                f"init.path={start.name}: this agent was trained with {option}, the run has {ours[key]}; "
                f"give {option} or start with init=none."
            )


def keep(agent: Rainbow, config: TrainConfig, phase: Phase, result: TrainingResult) -> None:
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


def check_finished(config: TrainConfig, phase: Phase) -> None:
    """Refuse to go on after a first phase that was another one than ``config`` asks for.

    Raises:
        UserError: it had another length or traffic.
    """
    training = read_agent(phase.folder / AGENT_FILE)[2]["training"]
    done, asked = training["decisions"], phase.total_decisions
    if not asked <= done < asked + config.collector.environments:
        raise UserError(
            f"pretrain.total_decisions={asked}: this phase is over, after {done} decisions; resume with what the run "
            "was started with."
        )
    if flat(training["traffic"]) != flat(phase.traffic.description()):
        raise UserError("traffic@pretrain.traffic: this phase is over, on other traffic; resume with the same.")


def length_of(agent: Path) -> dict[str, float]:
    """Decisions, updates and wall time of the finished phase that left ``agent``."""
    training = read_agent(agent)[2]["training"]
    return {name: training[name] for name in ("decisions", "updates", "wall_s")}
