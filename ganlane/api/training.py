"""``train``: an agent, as ``ganlane train`` trains it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from ganlane.api.folders import Run, results_of, run_in
from ganlane.api.options import Option, command_config, option
from ganlane.config.train import TrainConfig
from ganlane.errors import UserError


@dataclass(frozen=True)
class TrainingRun(Run):
    """What a training run left: also the agent's file and the table of the final evaluation."""

    agent: Path
    table: pl.DataFrame


def train(
    traffic: Option = "gan",
    init: Option = "idm_ckpt",
    *,
    total_decisions: int = 600_000,
    seed: int = 0,
    agent: Option = "transfer",
    env: Option = "highway",
    observation: Option = "lane_view_overlap",
    reward: Option = "paper",
    mask: Option = "safe",
    num_envs: int = 512,
    logger: Option = "csv",
    evaluation: Mapping[str, Any] | None = None,
    pretrain: Mapping[str, Any] | None = None,
    folder: str | Path | None = None,
    resume: bool = False,
    **overrides: Any,
) -> TrainingRun:
    """Train an agent on a traffic, then evaluate it beside others on the same episodes.

    ::

        run = train("gan", "idm_ckpt", total_decisions=3_000_000, lanes=4, evaluation={"episodes": 1000})
        evaluate([str(run.agent), "mobil", "random_legal"], ["gan"], lanes=4)

    On the command line::

        ganlane train traffic=gan init=idm_ckpt total_decisions=3000000 env.lanes=4 evaluation.episodes=1000

    Args:
        traffic, env, observation, reward, mask: as in :func:`ganlane.api.make_env`.
        init: ``idm_ckpt`` (the agent that ships), ``none``, or ``{"name": "idm_ckpt", "path": FILE}``; ``support``
            and ``optimizer`` are further keys (docs/training.md, 'Transfer').
        total_decisions: of all environments together.
        seed: of everything.
        agent: ``transfer``, ``rainbow`` (to train from nothing), ``dqn``, or a mapping such as ``{"gamma": 0.99}``.
        num_envs: environments side by side.
        logger: ``csv``, ``tensorboard``, or a mapping such as ``{"progress": False}``.
        evaluation: keys of the final evaluation: ``agents, episodes, num_envs, traffic``.
        pretrain: a first phase, ``{"traffic": "idm_mobil", "total_decisions": 10_000_000}``.
        folder: the run's; None: a new one below ``outputs/train``.
        resume: go on with the run in ``folder``; the other arguments must be those that it was started with.
        overrides: keys of the command (``evaluate_every``, ``log_every``, ``device``, ...) or of the environment.

    Raises:
        UserError: a wrong value, an agent or checkpoint that does not fit.
        KeyboardInterrupt: stopped by Ctrl-C; the run is saved, ``resume=True`` goes on from there.
    """
    from ganlane.config.app import Stopped
    from ganlane.train import train as command

    if resume and folder is None:
        raise UserError("resume=True: which run? give its folder, for instance folder='outputs/train/RUN'.")
    parts: dict[str, Option] = {"traffic": traffic, "init": init, "agent": agent, "env": env}
    parts |= {"observation": observation, "reward": reward, "mask": mask, "logger": logger}
    parts |= {"collector": {"num_envs": num_envs}}
    told: dict[str, Any] = {"total_decisions": total_decisions, "seed": seed}
    told |= {"evaluation": _with_traffic(evaluation), "pretrain": _with_traffic(pretrain)}
    config = command_config(TrainConfig, parts, {**overrides, **told, "resume": str(folder) if resume else None})
    try:
        home, _ = run_in(folder, "train", command, config)
    except Stopped as stop:
        raise KeyboardInterrupt("the run was saved; go on with its folder and resume=True") from stop
    results = results_of(home)
    table = pl.DataFrame(results["rows"], infer_schema_length=None)
    return TrainingRun(home, results, Path(results["agent"]), table)


def _with_traffic(keys: Mapping[str, Any] | None) -> dict[str, Any]:
    """Keys of a phase, its traffic as a config."""
    given = dict(keys or {})
    if given.get("traffic") is not None:
        given["traffic"] = option("traffic", given["traffic"])
    return given
