"""The training loop: collect, n-step, store, update, log, evaluate, checkpoint."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from ganlane.agents import GreedyPolicy, Rainbow
from ganlane.settings.train import TrainConfig
from ganlane.training.checkpoint import Checkpointer, TrainingState
from ganlane.training.logs import Log, Logs

#: Evaluates the greedy policy on fixed episodes and returns its figures by name, with
#: ``mean_reward``, by which the best agent is chosen.
Evaluate = Callable[[GreedyPolicy], Mapping[str, float]]
#: Signals that end a run.
STOPPING = (signal.SIGINT, signal.SIGTERM)


@dataclass(frozen=True)
class TrainingResult:
    """Result of a run.

    Attributes:
        progress: ``decisions``, ``updates`` and ``wall_s``, the seconds that it took.
        best: mean reward of the best evaluation; None without evaluations.
        stopped_by: number of the signal that stopped it early; None: it came to its end.
        checkpoint: the file to resume from.
    """

    progress: dict[str, Any]
    best: float | None
    stopped_by: int | None
    checkpoint: Path


@contextmanager
def noted_signals() -> Iterator[list[int]]:
    """Context in which SIGINT and SIGTERM do not end the process but are noted in a list.

    A second Ctrl-C raises KeyboardInterrupt as usual. Outside the main thread, where Python allows
    no handlers, the context does nothing.
    """
    noted: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        # The second Ctrl-C of someone who cannot wait.
        if noted and number == signal.SIGINT:
            raise KeyboardInterrupt
        noted.append(number)

    # Signals can be handled in the main thread alone.
    previous = {}
    if threading.current_thread() is threading.main_thread():
        previous = {number: signal.signal(number, note) for number in STOPPING}

    try:
        yield noted
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def train(
    env: EnvBase,
    agent: Rainbow,
    config: TrainConfig,
    run_folder: str | Path,
    evaluate: Evaluate | None = None,
    logs: Sequence[Log] = (),
    metadata: Mapping[str, Any] | None = None,
    resume: str | Path | None = None,
    identity: Mapping[str, Any] | None = None,
) -> TrainingResult:
    """Train ``agent`` in ``env`` until all decisions are made or a signal stops it.

    A checkpoint is written at the end, and on the way ``checkpoint_every_s`` seconds after the last
    one; later if writing is slow, so that it takes at most 2 % of the time.

    Args:
        env: batch [N], writes ``observation`` and ``reward``; a resumed run is exact only if all of
            its state is in the TensorDict.
        agent: trained in place.
        config: length and schedule are read; the ``*_every`` count decisions over all environments.
        run_folder: gets ``metrics.csv``, ``evaluation.csv`` and
            ``checkpoints/{last.pt, last, best.safetensors}``.
        evaluate: called with the greedy policy every ``config.evaluate_every`` decisions.
        logs: logs in addition to the CSV files and the progress.
        metadata: JSON-serialisable, written into the agent's files, e.g. the name of the
            observation.
        resume: checkpoint to continue from.
        identity: plain data that identifies the run (environment, traffic, reward, seed); a
            checkpoint with another identity is refused
            (:class:`~ganlane.training.checkpoint.TrainingState`).

    Raises:
        UserError: the checkpoint is unreadable or of another run.
    """
    state = TrainingState(env, agent, identity)
    # None: everything could be restored.
    missing = None if resume is None else state.restore(resume)
    saver = Checkpointer(state, run_folder, config, metadata or {})

    actions = agent.network.config.actions
    shown = config.total_decisions if config.logger.progress else None
    # Logs are closed, and their last rows written, whatever ends the run.
    with closing(Logs(run_folder, actions, state.decisions, shown, logs)) as log:
        if missing is not None:
            log.say(f"resumed without {missing}; not bit-exact")
        if state.decisions == 0:
            saver.save()  # a run that is killed at any time can be resumed

        with noted_signals() as signals:
            # A signal ends the run between two decisions.
            while state.decisions < config.total_decisions and not signals:
                advance(state)
                log.advance(state.decisions)
                if state.passed(config.log_every):
                    log.write(metrics(state))
                if evaluate is not None and state.passed(config.evaluate_every):
                    keep_best(state, evaluate, log, saver)
                if saver.due():
                    saver.save()

            # The last agent is evaluated too, unless that has just been done.
            if evaluate is not None and not signals and state.evaluated_at < state.decisions:
                keep_best(state, evaluate, log, saver)
            saver.save()

    stopped_by = signals[-1] if signals else None
    return TrainingResult(state.progress(), state.best, stopped_by, saver.path)


def advance(state: TrainingState) -> TensorDictBase:
    """Make one decision of every environment, [N], and store it.

    While it is driven, the updates are made that the decisions before it made due; those of a
    run's last step are left to the run that goes on from it.
    """
    agent = state.agent
    # Exploration and learning rate follow the decisions made so far.
    agent.anneal(state.decisions)
    step = state.collector.step(agent, partial(learn, state))
    state.decisions += state.environments
    state.stats.step(step)
    # The window gives the transitions of n - 1 steps ago.
    agent.store(state.window.push(step))

    # Nothing becomes due until the buffer holds enough (``warmup``).
    if agent.ready:
        state.pending_decisions += state.environments
    return step


def learn(state: TrainingState) -> None:
    """Make the updates that are due, one per ``decisions_per_update``."""
    agent = state.agent
    per_update = agent.config.decisions_per_update
    # A light checkpoint leaves decisions that are due and an empty buffer. Decisions that do not
    # fill an update are kept for the next step.
    while agent.ready and state.pending_decisions >= per_update:
        state.stats.update(agent.update())
        state.pending_decisions -= per_update


def metrics(state: TrainingState) -> dict[str, float]:
    """A row of metrics, copied from the device."""
    agent = state.agent
    return {
        **state.progress(),
        **state.stats.read(),
        "sigma": float(agent.sigma()),
        "epsilon": agent.policy.epsilon,
    }


def keep_best(state: TrainingState, evaluate: Evaluate, log: Logs, saver: Checkpointer) -> None:
    """Evaluate the greedy policy; save it if it is the best so far."""
    # Noted first: an evaluation is not repeated at the end.
    state.evaluated_at = state.decisions
    row = dict(evaluate(state.agent.greedy))
    log.write_evaluation({"decisions": state.decisions, **row})

    reward = row["mean_reward"]
    if state.best is None or reward > state.best:
        state.best = reward
        saver.save_weights("best", row)
        saver.save()  # else a resumed run could replace the best agent by a worse one
