"""The training loop: collect, n-step, store, update, log, evaluate, checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from ganlane.agents import GreedyPolicy, Rainbow
from ganlane.errors import UserError
from ganlane.training.collectors import Source
from ganlane.training.config import TrainingConfig, TrainingResult
from ganlane.training.log import Log, Logs
from ganlane.training.run import Run
from ganlane.training.saver import Saver
from ganlane.training.stop import StopRequest

#: Drives the greedy policy through fixed episodes and returns figures.
Evaluate = Callable[[GreedyPolicy], Mapping[str, float]]


def train(
    env: EnvBase | Source,
    agent: Rainbow,
    config: TrainingConfig,
    run_folder: str | Path,
    evaluate: Evaluate | None = None,
    logs: Sequence[Log] = (),
    metadata: Mapping[str, Any] | None = None,
    resume: str | Path | None = None,
    identity: Mapping[str, Any] | None = None,
) -> TrainingResult:
    """Train ``agent`` in ``env`` until all decisions are made or a signal asks to stop; leave a checkpoint.

    Args:
        env: batch [N], writes ``observation`` and ``reward``; its state must travel in the TensorDict for a resumed
            run to be exact. Or a source of steps (:mod:`ganlane.training.collectors`), which the caller closes.
        agent: trained in place.
        config: length and rhythm.
        run_folder: gets ``metrics.csv``, ``evaluation.csv`` and ``checkpoints/{last.pt, last, best.safetensors}``.
        evaluate: called with the greedy policy every ``config.evaluate_every`` decisions.
        logs: further logs besides the CSV files and the progress.
        metadata: JSON-serialisable, written into the agent's files, e.g. the name of the observation.
        identity: plain data that makes the run what it is (environment, traffic, reward, seed); a run with another
            one is not resumed.
        resume: checkpoint to go on from (see :func:`ganlane.training.checkpoints.find_checkpoint`).

    Raises:
        UserError: the checkpoint is unreadable or of another run, or ``config.best_metric`` is not evaluated.
    """
    run = Run(env, agent, identity)
    missing = None if resume is None else run.restore(resume)
    saver = Saver(run, run_folder, config, metadata or {})
    with closing(Logs(Path(run_folder), config, agent.network.config.actions, run.decisions, logs)) as log:
        if missing is not None:
            log.say(f"resumed without {missing}; not bit-exact")
        stopped_by = _loop(run, config, evaluate, log, saver)
    return TrainingResult(run.decisions, agent.updates, run.wall_s, run.best, stopped_by, saver.path)


def _loop(run: Run, config: TrainingConfig, evaluate: Evaluate | None, log: Logs, saver: Saver) -> int | None:
    """The algorithm; the number of the signal that ended it early, or None."""
    run.source.open(run.agent)
    if run.decisions == 0:
        saver.save()  # so that there is something to go on from, whenever the run is killed
    with StopRequest() as stop:
        while run.decisions < config.total_decisions and stop.signal is None:
            step = collect(run)
            run.agent.store(run.window.push(step))
            learn(run)
            log.advance(run.decisions)
            if run.passed(config.log_every):
                log.write(figures(run))
            if evaluate is not None and run.passed(config.evaluate_every):
                assess(run, evaluate, config.best_metric, log, saver)
            if saver.due():
                saver.save()
        if evaluate is not None and stop.signal is None and run.assessed < run.decisions:
            assess(run, evaluate, config.best_metric, log, saver)
        saver.save()
    return stop.signal


@torch.no_grad()
def collect(run: Run) -> TensorDictBase:
    """One decision of every environment."""
    run.agent.anneal(run.decisions)
    step = run.source.step(run.agent)
    run.decisions += run.environments
    run.meter.step(step)
    return step


def learn(run: Run) -> None:
    """As many updates as the decisions since the last one pay for; none before the buffer is full enough."""
    if not run.agent.ready:
        return
    run.owed += run.environments
    while run.owed >= run.agent.config.decisions_per_update:
        run.meter.update(run.agent.update())
        run.owed -= run.agent.config.decisions_per_update


def figures(run: Run) -> dict[str, float]:
    """A row of metrics, read from the device."""
    agent = run.agent
    row = {"decisions": run.decisions, "updates": agent.updates, "wall_s": run.wall_s, **run.meter.read()}
    return row | {"sigma": float(agent.sigma()), "epsilon": agent.policy.epsilon}


def assess(run: Run, evaluate: Evaluate, best_metric: str, log: Logs, saver: Saver) -> None:
    """Evaluate the greedy policy and keep the best agent so far."""
    run.assessed = run.decisions
    row = dict(evaluate(run.agent.greedy))
    log.write_evaluation({"decisions": run.decisions, **row})
    if best_metric not in row:
        known = ", ".join(row)
        raise UserError(f"best_metric={best_metric}: not among the evaluation's figures; choose one of {known}.")
    if run.best is None or row[best_metric] > run.best:
        run.best = row[best_metric]
        saver.save_weights("best", row)
        saver.save()  # a resumed run must know of the best, or a worse one could take its place
