"""The commands as typed Python calls, for notebooks and scripts.

::

    import ganlane

    agent = ganlane.load_agent("agent_idm")
    env = ganlane.make_env(traffic="gan", num_envs=64, observation=agent.observation, mask=agent.mask)
    rollout = env.rollout(100, agent.policy)
    table = ganlane.api.evaluate([agent, "mobil", "random_legal"], ["idm_mobil", "gan"], episodes=100)

Options are names, mappings or config dataclasses (:mod:`ganlane.options`), checked as on the
command line. Mistakes raise :class:`ganlane.errors.UserError` with one sentence. docs/python_api.md
compares calls and commands.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any, TypeAlias

import polars as pl
import torch
from omegaconf import OmegaConf
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import Transform, TransformedEnv

from ganlane import build
from ganlane.agents.checkpoint import with_seeds
from ganlane.arguments import checked_arguments, whole_number
from ganlane.build import Driver
from ganlane.compare import compare
from ganlane.config.app import Stopped, function_of
from ganlane.config.command_line import ALIASES
from ganlane.config.commands import EvaluateConfig, RunConfig
from ganlane.config.env import check_reward
from ganlane.config.runs import CONFIG, LAST, cleared_after_mistakes, held
from ganlane.config.schemas import SCHEMAS
from ganlane.config.traffic import TrafficConfig, all_traffics
from ganlane.errors import UserError
from ganlane.evaluation import evaluation_rows, paired_rows, write_episodes, write_results
from ganlane.evaluation.results import Run, TrainingRun, plain
from ganlane.files import write_bytes
from ganlane.options import Option, command_config, option
from ganlane.parameters import did_you_mean
from ganlane.sim.random import Stream
from ganlane.torch_settings import set_threads

__all__ = [
    "Driver",
    "Run",
    "TrainingRun",
    "evaluate",
    "load_agent",
    "make_env",
    "render",
    "run",
    "train",
]

#: A driver's name, a loaded driver, or a policy of your own (named by its class).
Agent: TypeAlias = str | Path | Driver | TensorDictModuleBase


@checked_arguments
def make_env(
    traffic: Option = "idm_mobil",
    num_envs: int = 1,
    *,
    env: Option = "highway",
    observation: Option = "lane_view_overlap",
    reward: Option = "paper",
    mask: Option = "none",
    transforms: Sequence[Transform] = (),
    seed: int = 0,
    stream: str = "train",
    device: str = "cpu",
    **overrides: Any,
) -> TransformedEnv:
    """A batched TorchRL environment with observation and reward.

    ``make_env("gan", 256, lanes=4, recycle=True)`` is
    ``traffic=gan collector.num_envs=256 env.lanes=4 env.recycle=true`` on the command line.

    Args:
        traffic: an option of the group ``traffic``, such as ``idm_mobil`` or
            ``{"name": "gan", "noise_scale": 0.5}``; or the import path or the class of a model of
            your own.
        num_envs: N, environments side by side, 1 to 65536.
        env: ``highway``, ``dense``, or a scenario such as ``cut_in``.
        observation: an option of the group ``observation`` (docs/agent.md), or a mapping.
        reward: ``paper``, ``considerate``, or a mapping of what differs from ``paper``,
            ``{"hard_crash": -200}``.
        mask: ``none``, ``legal`` or ``safe`` (writes ``action_mask`` [N, 3] bool), or a mapping.
        transforms: your own, after observation and reward.
        seed: of the random numbers.
        stream: family of the episodes: ``train``, ``select`` or ``report`` (that of ``evaluate``).
        device: ``cpu`` or ``cuda``.
        overrides: keys of the environment (:class:`ganlane.config.env.EnvConfig`),
            ``lanes=4, idm={"headway_s": 1}``.

    Raises:
        UserError: an unknown name or key, a value of the wrong type or out of range.
    """
    config, rewards = option("env", env, overrides), option("reward", reward)
    check_reward(config, rewards)
    checked = RunConfig(seed=int(seed), device=device)
    batch = build.make_env(
        build.make_traffic(option("traffic", traffic), config, Stream.named(stream)),
        config,
        option("observation", observation),
        rewards,
        whole_number("num_envs", num_envs, 1, 65536),
        checked.seed,
        checked.device,
        mask=option("mask", mask),
    )
    for transform in transforms:
        batch.append_transform(transform)
    return batch


@checked_arguments
def load_agent(
    name: str | Path = "agent_general",
    *,
    env: Option = "highway",
    stream: str = "report",
    device: str = "cpu",
    **overrides: Any,
) -> Driver:
    """A driver of the ego: its ``policy``, the ``observation`` it reads (None: the raw state) and
    its ``mask``.

    Args:
        name: a shipped agent, a rule-based driver (``mobil``, ``mobil_egoistic``, ``keep_lane``,
            ``random_legal``, ``random``), the path of an agent's ``.safetensors``, or the import
            path of a policy of your own.
        env, overrides: the environment it drives in, as in :func:`make_env`; a network must fit.
        stream: stream of its random numbers, if it draws any.
        device: device of its network.

    Raises:
        UserError: no such driver, or its network takes another observation.
    """
    config = option("env", env, overrides)
    return build.make_driver(
        str(name), config, Stream.named(stream), RunConfig(device=device).device
    )


@checked_arguments
def evaluate(
    agents: Sequence[Agent] = ("mobil", "keep_lane", "random_legal", "agent_idm"),
    traffics: Sequence[Option] | Mapping[str, Option] = (
        "idm",
        "idm_mobil",
        "gan",
        "gan_calibrated",
    ),
    episodes: int = 100,
    *,
    seed: int = 0,
    per_episode: bool = False,
    folder: str | Path | None = None,
    **keys: Any,
) -> pl.DataFrame:
    """Evaluate every agent on every traffic, on the same episodes; one row for each pair.

    Args:
        agents: names, drivers from :func:`load_agent`, or policies of your own; ``mobil`` and
            ``random_legal`` are needed for the normalised score.
        traffics: options as in :func:`make_env`, or a mapping that gives them names of your own.
        episodes: the episodes 0 to ``episodes - 1`` of the seed, on the stream kept for reports.
        seed: of the episodes.
        per_episode: one row per episode instead (:func:`ganlane.evaluation.run_episodes`).
        folder: write ``results.json`` and ``episodes.parquet`` there, as the command does.
        keys: further options (``env``, ``reward``; ``observation`` and ``mask`` for policies that
            name none), keys of the command (``num_envs``, ``device``, ``stream``) or of the
            environment.

    Returns:
        The columns of :func:`ganlane.evaluation.evaluation_rows`; null where there is no number.

    Raises:
        UserError: an unknown name, a wrong value, or a policy that does not fit.
        OSError: a folder that cannot be written to.
    """
    chosen = _named_traffics(traffics)
    given = [
        each
        for agent in agents
        for each in (with_seeds(agent) if isinstance(agent, str) else [agent])
    ]
    agents = [
        Driver(type(each).__name__, each) if isinstance(each, TensorDictModuleBase) else each
        for each in given
    ]
    names = [agent.name if isinstance(agent, Driver) else str(agent) for agent in agents]
    keys |= {"agents": names, "traffics": list(chosen)}
    keys |= {"episodes": episodes, "seed": seed, "traffic_options": {**all_traffics(), **chosen}}
    config: EvaluateConfig = command_config("evaluate", keys)
    with (
        _torch_threads(config.threads),
        cleared_after_mistakes(Path(folder)) if folder is not None else nullcontext(),
    ):
        if folder is not None:  # before hours of driving
            Path(folder).mkdir(parents=True, exist_ok=True)
        drivers = [
            agent
            if isinstance(agent, Driver)
            else build.make_driver(name, config.env, device=config.device)
            for agent, name in zip(agents, config.agents)
        ]
        table = compare(drivers, config)
    rows = plain(evaluation_rows(table))
    if folder is not None:
        seeds = {"stream": config.stream, "seed": config.seed, "episodes": [0, config.episodes - 1]}
        write_episodes(Path(folder), table)
        write_results(
            Path(folder), {"rows": rows, "paired": paired_rows(table)}, asdict(config), seeds
        )
    return table if per_episode else pl.DataFrame(rows, infer_schema_length=None)


@checked_arguments
def train(
    traffic: Option = "gan",
    init: Option = "idm_ckpt",
    *,
    total_decisions: int = 600_000,
    seed: int = 0,
    num_envs: int = 512,
    evaluation: Mapping[str, Any] | None = None,
    pretrain: Mapping[str, Any] | None = None,
    folder: str | Path | None = None,
    resume: bool = False,
    **keys: Any,
) -> TrainingRun:
    """Train an agent on a traffic, then compare it with other drivers on the same episodes.

    Args:
        traffic: as in :func:`make_env`.
        init: ``idm_ckpt`` (the agent that ships), ``none``, or ``{"path": FILE}``
            (docs/training.md, 'Transfer').
        total_decisions: of all environments together.
        seed: of everything.
        num_envs: environments side by side.
        evaluation: keys of the final evaluation: ``agents, episodes, num_envs, traffic``.
        pretrain: a first phase, ``{"traffic": "idm_mobil", "total_decisions": 10_000_000}``.
        folder: the run's; None: a new one below ``outputs/train``.
        resume: continue the run in ``folder``; the other arguments must be those of its start.
        keys: further options (``env``, ``observation``, ``reward``, ``mask``, ``agent``,
            ``logger``), keys of the command (``evaluate_every``, ``log_every``, ``device``, ...) or
            of the environment.

    Raises:
        UserError: a wrong value, an agent or checkpoint that does not fit.
        KeyboardInterrupt: stopped by Ctrl-C; the run is saved, ``resume=True`` continues it.
    """
    if resume and folder is None:
        raise UserError(
            "resume=True: which run? give its folder, for instance folder='outputs/train/RUN'."
        )
    keys |= {"traffic": traffic, "init": init, "total_decisions": total_decisions, "seed": seed}
    keys |= {"collector": {"num_envs": num_envs}, "resume": str(folder) if resume else None}
    keys |= {"evaluation": _with_traffic(evaluation), "pretrain": _with_traffic(pretrain)}
    try:
        finished = run("train", folder, **keys)
    except Stopped as stop:
        raise KeyboardInterrupt(
            "the run was saved; go on with its folder and resume=True"
        ) from stop
    table = pl.DataFrame(finished.results["rows"], infer_schema_length=None)
    return TrainingRun(finished.folder, finished.results, Path(finished.results["agent"]), table)


@checked_arguments
def render(
    agent: str | Path | Sequence[str | Path] = "mobil",
    traffic: Option = "idm_mobil",
    episode: int | Sequence[int] = 0,
    *,
    out: str | Path | None = None,
    run: str | Path | Sequence[str | Path] | None = None,
    film: Mapping[str, Any] | None = None,
    **keys: Any,
) -> Path:
    """Write episodes as a film, page or table, or the learning curves of runs; return the file's
    path.

    Args:
        agent: as ``name`` in :func:`load_agent`; several for html, csv and parquet.
        traffic: as in :func:`make_env`.
        episode: number of the episode, the same as in ``evaluate``; several as for ``agent``.
        out: file to write; None: into a new folder below ``outputs/render``.
        run: folders of training runs; their learning curves are drawn instead of an episode.
        film: keys of the film: ``fps, speedup, start_s, end_s, width, height, ...``.
        keys: further options (``env``, ``observation``, ``reward``, ``mask``), keys of the command
            (``seed``; ``format``, by default the ending of ``out``, else ``gif``) or of the
            environment.

    Raises:
        UserError: a wrong value.
        OSError: a file that cannot be written.
    """
    keys |= {"driver": agent} if isinstance(agent, str | Path) else {"agents": list(agent)}
    keys |= (
        {"episode": episode} if not isinstance(episode, Iterable) else {"episodes": list(episode)}
    )
    if run is not None:
        keys["run"] = [str(each) for each in ([run] if isinstance(run, str | Path) else run)]
    config = command_config("render", {**keys, "traffic": traffic, "film": film or {}, "out": out})
    if out is None:
        _, line = _run_in(None, "render", config)
    else:
        with _torch_threads():
            line = function_of("render")(config, Path(out).parent)
    return Path(line.partition(": ")[2])


@checked_arguments
def run(command: str, folder: str | Path | None = None, **keys: Any) -> Run:
    """Run any command that writes ``results.json``: ``record``, ``prepare``, ``realism`` ...

    ``run("prepare", data={"name": "ngsim", "path": "raw.txt"}, out="us101")`` is
    ``ganlane prepare data=ngsim data.path=raw.txt out=us101`` on the command line.

    Args:
        command: its name; ``ganlane COMMAND --help`` lists its options and keys.
        folder: of the run; None: a new one below ``outputs/COMMAND``.
        keys: options by group (``data=``, ``traffic=``), keys of the command and, where it has one,
            of the environment. Defaults are the command's.

    Raises:
        UserError: no such command, a wrong value, or recordings that cannot be read.
    """
    # render writes a picture and no results
    known = [name for name in SCHEMAS[""] if name != "render"]
    if command not in known:
        hint = did_you_mean(command, known)
        raise UserError(
            f"run({command!r}): no such command{hint}; choose one of {', '.join(known)}."
        )
    resumed = keys.get("resume")
    of_folder = (
        folder is not None and str(resumed) == str(folder) and any(Path(folder).rglob(LAST.name))
    )
    if resumed is not None and not of_folder:
        raise UserError(
            f"resume={resumed}: no run that can go on ({LAST} is missing); give api.train() the folder of one, and "
            "resume=True."
        )
    named = {ALIASES.get(command, {}).get(name, name): value for name, value in keys.items()}
    home, _ = _run_in(folder, command, command_config(command, named))
    return Run(home, json.loads((home / "results.json").read_text()))


def _run_in(folder: str | Path | None, command: str, config: Any) -> tuple[Path, str]:
    """Run a command in ``folder`` (None: a new one below ``outputs/COMMAND``); the folder and its
    result line.

    A mistake does not leave a new folder behind.
    """
    now = datetime.now().strftime("%Y-%m-%d_%H-%M-%S_%f")
    home = Path("outputs") / command / now if folder is None else Path(folder)
    with cleared_after_mistakes(home), held(home), _torch_threads():
        write_bytes(home / CONFIG, OmegaConf.to_yaml(OmegaConf.structured(config)).encode())
        return home, function_of(command)(config, home)


@contextmanager
def _torch_threads(threads: int = 0) -> Iterator[None]:
    """Set torch's threads as the commands do, and restore the caller's number afterwards."""
    before = torch.get_num_threads()
    set_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _named_traffics(traffics: Sequence[Option] | Mapping[str, Option]) -> dict[str, TrafficConfig]:
    """Traffics by their names in the table."""
    if isinstance(traffics, Mapping):
        return {name: option("traffic", chosen) for name, chosen in traffics.items()}
    configs = [option("traffic", chosen) for chosen in traffics]
    labels = [config.label() for config in configs]
    if len(set(labels)) < len(labels):
        raise UserError(
            f"traffics={labels}: one name twice; give names of your own, traffics={{'mine': ..., 'other': ...}}."
        )
    return dict(zip(labels, configs))


def _with_traffic(keys: Mapping[str, Any] | None) -> dict[str, Any]:
    """Keys of a training phase, its traffic as a config."""
    values = dict(keys or {})
    if values.get("traffic") is not None:
        values["traffic"] = option("traffic", values["traffic"])
    return values
