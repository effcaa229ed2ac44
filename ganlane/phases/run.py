"""A phase, run: from the agent it starts with to the one it leaves."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from ganlane.config.train import TrainConfig
from ganlane.phases.agent import begin, keep
from ganlane.phases.description import describe, identity
from ganlane.phases.phase import Phase
from ganlane.phases.selection import make_selection
from ganlane.phases.source import make_source
from ganlane.training import TrainingConfig, TrainingResult, make_logs, train


def run_phase(config: TrainConfig, phase: Phase, resume: str | Path | None = None) -> TrainingResult:
    """Train the agent of one phase and write its :data:`AGENT_FILE`, unless a signal stopped it early.

    Args:
        config: of the whole run.
        phase: which part of it.
        resume: checkpoint to go on from.

    Raises:
        UserError: the agent to start from, the weights of the traffic or the checkpoint do not fit.
    """
    config, agent = begin(config, phase, resume)
    with closing(make_source(config, phase)) as source:
        result = train(
            source,
            agent,
            _rhythm(config, phase),
            phase.folder,
            evaluate=make_selection(config, phase) if config.evaluate_every else None,
            logs=make_logs(config.logger, phase.folder, describe(config, phase)),
            metadata=describe(config, phase),
            resume=resume,
            identity=identity(config, phase),
        )
    if result.stopped_by is None:
        keep(agent, config, phase, result)
    return result


def _rhythm(config: TrainConfig, phase: Phase) -> TrainingConfig:
    return TrainingConfig(
        total_decisions=phase.total_decisions,
        log_every=config.log_every,
        evaluate_every=config.evaluate_every,
        checkpoint_every_s=config.checkpoint_every_s,
        checkpoint_replay=config.checkpoint_replay,
        progress=config.logger.progress,
    )
