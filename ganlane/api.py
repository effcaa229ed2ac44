"""The commands as typed Python calls, for notebooks and scripts: the same words, the same checks.

::

    import ganlane

    agent = ganlane.load_agent("agent_idm")
    env = ganlane.make_env("gan", 64, observation=agent.observation, mask=agent.mask, lanes=4)
    rollout = env.rollout(100, agent.policy, break_when_any_done=False)
    calmer = {"name": "gan", "noise_scale": 0.5}
    table = ganlane.api.evaluate([agent, "mobil"], {"gan": "gan", "calmer": calmer}, episodes=100)

An option is a name, a mapping of its keys (with its name as ``name``), a record, or for ``traffic``
a class of your own or its import path. Keys of the environment may be given alone: ``lanes=4`` is
``env.lanes=4``. Mistakes raise :class:`ganlane.errors.UserError` with one sentence.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import polars as pl
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import Transform, TransformedEnv

from ganlane import build
from ganlane.agents.drivers import FunctionPolicy
from ganlane.build import Driver
from ganlane.config.run import (
    COMMANDS,
    LAST,
    Stopped,
    call_settings,
    function_of,
    new_folder,
    running,
)
from ganlane.errors import UserError, did_you_mean
from ganlane.evaluation import evaluation_rows
from ganlane.evaluation.results import Run, TrainingRun, as_json
from ganlane.runtime import worker_number
from ganlane.settings.commands import EvaluateConfig, highways
from ganlane.settings.record import Record
from ganlane.sim.random import Stream
from ganlane.suite.driving import compare
from ganlane.suite.run import drivers_of
from ganlane.suite.run import run as run_suite
from ganlane.torch_settings import torch_threads

#: An option's name; a mapping of its keys, with its name as ``name``; or its record.
Option: TypeAlias = str | Mapping[str, Any] | Record | type
#: A driver's name, a loaded driver, or a policy of your own (named by its class).
Agent: TypeAlias = str | Path | Driver | TensorDictModuleBase
#: The same, or a function of observations.
Policy: TypeAlias = Agent | Callable[..., Any]


def make_env(
    traffic: Option = "idm_mobil",
    num_envs: int = 1,
    *,
    transforms: Sequence[Transform] = (),
    **keys: Any,
) -> TransformedEnv:
    """A batched TorchRL environment with observation and reward.

    ``make_env("gan", 256, lanes=4, recycle=True)`` is ``traffic=gan num_envs=256
    env.lanes=4 env.recycle=true`` on the command line.

    Args:
        traffic: an option of the group ``traffic``, such as ``idm_mobil`` or ``{"name": "gan",
            "noise_scale": 0.5}``; or the import path or the class of a model of your own.
        num_envs: N, environments side by side, 1 to 65536.
        transforms: your own, after observation and reward.
        keys: the options ``env`` (``highway``, ``dense``, a scenario such as ``cut_in``),
            ``observation``, ``reward`` and ``mask`` (``none``, ``legal``, ``safe``); ``seed``, by
            default 0, and in a worker process of TorchRL the worker's number; ``stream``, the
            family of the episodes (``train``, ``select``, ``report``); ``device``; and keys of the
            environment (:class:`ganlane.settings.env.EnvConfig`).

    Raises:
        UserError: an unknown name or key, a value of the wrong type or out of range.
    """
    # Workers of TorchRL share one call of this function, and must not share their episodes.
    keys.setdefault("seed", worker_number())
    # Settings first: a mistake in them is reported before anything is built.
    config = highways(traffic=traffic, num_envs=num_envs, **keys)
    batch = build.make_highways(config)
    # TorchRL refuses what is no transform by TypeError or ValueError.
    try:
        for transform in transforms:
            batch.append_transform(transform)
    except (TypeError, ValueError) as error:
        raise UserError(f"transforms: {error}; give a list of TorchRL's transforms.") from error
    return batch


def load_agent(
    name: str | Path = "agent_general", *, stream: str = "report", **keys: Any
) -> Driver:
    """A driver of the ego: its ``policy``, the ``observation`` it reads and its ``mask``.

    The observation is None for a driver that reads the raw state.

    Args:
        name: a shipped agent, a rule-based driver (``mobil``, ``mobil_egoistic``, ``keep_lane``,
            ``random_legal``, ``random``), the path of an agent's ``.safetensors``, or the import
            path of a policy of your own.
        stream: stream of its random numbers, if it draws any.
        keys: ``device``, and the environment it drives in as in :func:`make_env`; a network must
            fit.

    Raises:
        UserError: no such driver, or its network takes another observation.
    """
    config = highways(stream=stream, **keys)
    # The random numbers of a driver come from the stream of the episodes that it drives.
    return build.make_driver(str(name), config.env, Stream.named(config.stream), config.device)


def evaluate(
    agents: Policy | Sequence[Policy] | Mapping[str, Policy] = (
        "mobil",
        "keep_lane",
        "random_legal",
        "agent_idm",
    ),
    traffics: Sequence[Option] | Mapping[str, Option] = (
        "idm",
        "idm_mobil",
        "gan",
        "gan_calibrated",
    ),
    episodes: int = 100,
    *,
    per_episode: bool = False,
    **keys: Any,
) -> pl.DataFrame:
    """Evaluate every agent on every traffic, on the same episodes; one row for each pair.

    Args:
        agents: names, drivers from :func:`load_agent`, policies or functions of your own, as in
            :func:`benchmark`; ``mobil`` and ``random_legal`` are needed for the normalised score.
        traffics: options as in :func:`make_env`, or a mapping that gives them names of your own.
        episodes: the episodes 0 to ``episodes - 1`` of the seed, on the stream kept for reports; of
            ``replay`` the first ones that drive each recorded start once.
        per_episode: one row per episode instead (:func:`ganlane.evaluation.run_episodes`).
        keys: ``seed``, options (``env``, ``reward``; ``observation`` and ``mask`` for policies that
            name none), keys of the command (``num_envs``, ``device``, ``stream``) or of the
            environment.

    Returns:
        The columns of :func:`ganlane.evaluation.evaluation_rows`; null where there is no number.

    Raises:
        UserError: an unknown name, a wrong value, or a policy that does not fit.
    """
    if not isinstance(per_episode, bool):
        raise UserError(f"per_episode={per_episode!r:.80}: expected True or False.")
    config: EvaluateConfig = call_settings(
        "evaluate", {"traffics": traffics, "episodes": episodes, **keys}
    )
    with torch_threads(config.threads):
        drivers = _drivers(
            agents, lambda name: build.make_drivers([name], config.env, config.device)
        )
        # Two of one name would share a row of the table.
        config = replace(config, agents=[driver.name for driver in drivers])
        table = compare(drivers, config)
    if per_episode:
        return table
    # Plain Python numbers: polars takes no others.
    return pl.DataFrame(as_json(evaluation_rows(table)), infer_schema_length=None)


def benchmark(
    policy: Policy | Sequence[Policy] | Mapping[str, Policy] = "agent_general",
    *,
    suite: str | Mapping[str, Any] = "shift-v1",
    quick: bool = False,
    folder: str | Path | None = None,
    **keys: Any,
) -> Run:
    """Drive a suite and score what drove; see docs/benchmark.md.

    Args:
        policy: an agent of ``ganlane benchmark``, a driver, a policy (a TensorDictModule), or a
            function that takes observations [N, D] as a NumPy array and returns N actions; or
            several of them, by names of your own in a mapping.
        suite: its protocol.
        quick: a fifth of the episodes.
        folder: of the run; None: a new one below ``outputs/benchmark``.
        keys: further keys of the command, such as ``observation`` and ``mask`` (of functions).

    Returns:
        The run; its ``results["entries"]`` hold the scores.

    Raises:
        UserError: an unknown name, a wrong value, or a policy that does not fit.
    """
    config = call_settings("benchmark", {"suite": suite, "quick": quick, **keys})
    home = _home("benchmark", folder)
    with running(home, config):
        drivers = _drivers(policy, lambda name: drivers_of([name], config))
        run_suite(drivers, config, home)
    return _finished(home)


def _drivers(policies: Any, load: Callable[[str], list[Driver]]) -> list[Driver]:
    """One policy, a list or a mapping of them as drivers; ``load`` gives those of a name."""
    # A name of the caller's, or None, with each policy.
    if isinstance(policies, Mapping):
        named = list(policies.items())
    elif isinstance(policies, list | tuple):
        named = [(None, policy) for policy in policies]
    else:
        named = [(None, policies)]

    drivers: list[Driver] = []
    for name, policy in named:
        if isinstance(policy, str | Path):
            several = load(str(policy))
        elif isinstance(policy, Driver):
            several = [policy]
        elif isinstance(policy, TensorDictModuleBase):
            several = [Driver(type(policy).__name__, policy)]
        elif callable(policy):
            usual = getattr(policy, "__name__", type(policy).__name__)
            several = [Driver(usual, FunctionPolicy(policy))]
        else:
            raise UserError(f"{policy!r:.80}: expected an agent's name, a policy or a function.")

        # Several trainings stay one entry under a name of the caller's.
        for number, driver in enumerate(several):
            place = "" if len(several) == 1 else f"@{number}"
            drivers.append(driver if name is None else driver.renamed(f"{name}{place}"))
    return drivers


def train(
    traffic: Option | None = None,
    init: Option | None = None,
    *,
    num_envs: int | None = None,
    folder: str | Path | None = None,
    resume: bool = False,
    **keys: Any,
) -> TrainingRun:
    """Train an agent on a traffic, then compare it with other drivers on the same episodes.

    Args:
        traffic: as in :func:`make_env`; None: ``gan``.
        init: ``idm_ckpt`` (the agent that ships), ``none``, or ``{"path": FILE}``; None:
            ``idm_ckpt``.
        num_envs: environments side by side; None: 512.
        folder: the run's; None: a new one below ``outputs/train``.
        resume: go on with the run in ``folder``, with its settings; arguments change them.
        keys: ``total_decisions``, ``seed``, ``evaluation`` (its keys ``agents, episodes, num_envs,
            traffic``), ``pretrain`` (``{"traffic": "idm_mobil", "total_decisions": 10_000_000}``),
            ``experiment``, options (``env``, ``observation``, ``reward``, ``mask``, ``agent``,
            ``logger``), further keys of the command or of the environment.

    Raises:
        UserError: a wrong value, an agent or checkpoint that does not fit.
        KeyboardInterrupt: stopped by Ctrl-C; the run is saved, ``resume=True`` continues it.
    """
    if not isinstance(resume, bool):
        raise UserError(f"resume={resume!r:.80}: expected True or False, and the run as folder.")
    if resume and folder is None:
        raise UserError(
            "resume=True: which run? give its folder, for instance folder='outputs/train/RUN'."
        )
    # None leaves the command's default, or what the resumed run has.
    named = {"traffic": traffic, "init": init, "num_envs": num_envs}
    keys |= {name: value for name, value in named.items() if value is not None}
    if resume:
        keys["resume"] = str(folder)

    try:
        finished = run("train", folder, **keys)
    except Stopped as stop:
        # Stopped carries the signal for the exit status of the command; a notebook knows Ctrl-C.
        raise KeyboardInterrupt(
            "the run was saved; go on with its folder and resume=True"
        ) from stop

    table = pl.DataFrame(finished.results["rows"], infer_schema_length=None)
    return TrainingRun(finished.folder, finished.results, Path(finished.results["agent"]), table)


def render(
    agent: str | Path | Sequence[str | Path] = "mobil",
    traffic: Option = "idm_mobil",
    episode: int | Sequence[int] = 0,
    *,
    out: str | Path | None = None,
    run: str | Path | Sequence[str | Path] | None = None,
    **keys: Any,
) -> Path:
    """Write episodes as a film, page or table, or the learning curves of runs; the file's path.

    Args:
        agent: as ``name`` in :func:`load_agent`; several for html and parquet.
        traffic: as in :func:`make_env`.
        episode: number of the episode, the same as in ``evaluate``; several as for ``agent``.
        out: file to write; None: into a new folder below ``outputs/render``.
        run: folders of training runs; their learning curves are drawn instead of an episode.
        keys: ``film`` (its keys ``fps, speedup, start_s, end_s, width, height, ...``), options
            (``env``, ``observation``, ``reward``, ``mask``), keys of the command (``seed``,
            ``stream``) or of the environment.

    Raises:
        UserError: a wrong value.
        OSError: a file that cannot be written.
    """
    words = {
        "traffic": traffic,
        "out": out,
        "agents": agent,
        "episodes": episode,
        "run": run,
    }
    config = call_settings("render", words | keys)
    # With no file to write named, the run gets a folder with its settings, as the command does.
    folder = new_folder("render") if out is None else Path(out).parent
    with running(folder, config) if out is None else torch_threads(config.threads):
        line = function_of("render")(config, folder)
    # The line is 'film: PATH' or alike; a path may itself hold ': ', so only the first one counts.
    return Path(str(line).partition(": ")[2])


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
    names = [name for name in COMMANDS if name != "render"]  # which writes a picture, no results
    if command not in names:
        hint = did_you_mean(command, names)
        raise UserError(
            f"run({command!r}): no such command{hint}; choose one of {', '.join(names)}."
        )

    # Going on with a run means its own folder.
    home = _home(command, folder)
    # Another run's checkpoint in a new folder would mix the results of two runs.
    if command == "train" and keys.get("resume") is not None:
        is_own = folder is not None and str(keys["resume"]) == str(folder)
        if not is_own or not any(home.rglob(LAST.name)):
            raise UserError(
                f"resume={keys['resume']}: no run that can go on ({LAST} is missing); give "
                "api.train() the folder of one, and resume=True."
            )
    config = call_settings(command, keys)
    with running(home, config):
        function_of(command)(config, home)
    return _finished(home)


def _finished(home: Path) -> Run:
    """The run in a folder."""
    # Commands write their results as a file; reading it back gives what a later reader would see.
    return Run(home, json.loads((home / "results.json").read_text(encoding="utf-8")))


def _home(command: str, folder: str | Path | None) -> Path:
    """The folder of a call; None: a new one.

    Raises:
        UserError: it is no path.
    """
    if folder is None:
        return new_folder(command)
    # Python refuses a zero byte only when the path is used
    if not isinstance(folder, str | Path) or "\0" in str(folder):
        raise UserError(f"folder={folder!r:.80}: expected a path, such as 'mine'.")
    return Path(folder)
