"""``evaluate``: agents x traffics on the same episodes, as a data frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeAlias

import polars as pl
from tensordict.nn import TensorDictModuleBase

from ganlane.api.folders import torch_threads
from ganlane.api.options import Option, command_config, option
from ganlane.build import Driver, make_driver
from ganlane.compare import compare_as_told
from ganlane.config.evaluate import EvaluateConfig
from ganlane.config.traffic import TrafficConfig, all_traffics
from ganlane.errors import UserError
from ganlane.evaluation import evaluation_rows, paired_rows, write_episodes, write_results
from ganlane.evaluation.results import plain

#: A driver's name, a loaded driver, or a policy of your own (named by its class).
Agent: TypeAlias = str | Driver | TensorDictModuleBase


def evaluate(
    agents: Sequence[Agent] = ("mobil", "keep_lane", "random_legal", "agent_idm"),
    traffics: Sequence[Option] | Mapping[str, Option] = ("idm", "idm_mobil", "gan", "gan_calibrated"),
    episodes: int = 100,
    *,
    seed: int = 0,
    num_envs: int = 512,
    env: Option = "highway",
    observation: Option = "lane_view_overlap",
    reward: Option = "paper",
    mask: Option = "none",
    device: str = "cpu",
    per_episode: bool = False,
    folder: str | Path | None = None,
    **overrides: Any,
) -> pl.DataFrame:
    """Every agent on every traffic, on the same episodes; one row for each pair.

    ::

        evaluate(["mobil", "random_legal", "agent_idm"], ["idm_mobil", "gan"], episodes=1000, lanes=4)

    On the command line::

        ganlane evaluate 'agents=[mobil,random_legal,agent_idm]' 'traffics=[idm_mobil,gan]' episodes=1000 env.lanes=4

    Args:
        agents: names, what :func:`ganlane.api.load_agent` returned, or policies of your own; ``mobil`` and
            ``random_legal`` are needed for the normalised score.
        traffics: names, import paths, classes or mappings (:func:`ganlane.api.make_env`); or names of your own for
            such, as a mapping.
        episodes: the episodes 0 to ``episodes - 1`` of the seed, on the stream kept for reports.
        seed: of the episodes.
        num_envs: episodes driven side by side; the numbers do not depend on it.
        env, reward: the same for all; ``overrides`` are keys of the environment.
        observation, mask: for policies that name none.
        device: ``cpu`` or ``cuda``.
        per_episode: one row per episode instead (:func:`ganlane.evaluation.run_episodes`).
        folder: write ``results.json`` and ``episodes.parquet`` there, as the command does.

    Returns:
        The columns of the command's ``rows`` (:func:`ganlane.evaluation.evaluation_rows`); null where there is no
        number.

    Raises:
        UserError: an unknown name, a wrong value, or a policy that does not fit.
    """
    named, given = [_name(agent) for agent in agents], _traffics(traffics)
    parts: dict[str, Option | None] = {"env": env, "observation": observation, "reward": reward, "mask": mask}
    told = {"episodes": episodes, "seed": seed, "num_envs": num_envs, "device": device}
    lists = {"agents": named, "traffics": list(given), "traffic_options": {**all_traffics(), **given}}
    config = command_config(EvaluateConfig, parts, {**overrides, **told, **lists})
    with torch_threads(config.threads):
        drivers = [_driver(agent, name, config) for agent, name in zip(agents, named)]
        table = compare_as_told(drivers, config)
    rows = plain(evaluation_rows(table))
    if folder is not None:
        _keep(Path(folder), table, rows, config)
    return table if per_episode else pl.DataFrame(rows, infer_schema_length=None)


def _name(agent: Agent) -> str:
    """How an agent is called in the table."""
    if isinstance(agent, (str, Path)):
        return str(agent)
    if isinstance(agent, Driver):
        return agent.name
    if isinstance(agent, TensorDictModuleBase):
        return type(agent).__name__
    raise UserError(
        f"agents: {agent!r} is no driver; give a name, what load_agent returned, or a TensorDictModule that writes "
        "'action'."
    )


def _driver(agent: Agent, name: str, config: EvaluateConfig) -> Driver:
    if isinstance(agent, Driver):
        return agent
    if isinstance(agent, TensorDictModuleBase):
        return Driver(name, agent)
    return make_driver(name, config.env, device=config.device)


def _traffics(traffics: Sequence[Option] | Mapping[str, Option]) -> dict[str, TrafficConfig]:
    """Traffic by its name in the table."""
    if isinstance(traffics, Mapping):
        return {name: option("traffic", chosen) for name, chosen in traffics.items()}
    made = [option("traffic", chosen) for chosen in traffics]
    labels = [config.label() for config in made]
    if len(set(labels)) < len(labels):
        raise UserError(
            f"traffics={labels}: one name twice; give names of your own, traffics={{'mine': ..., 'other': ...}}."
        )
    return dict(zip(labels, made))


def _keep(folder: Path, table: pl.DataFrame, rows: list[dict[str, Any]], config: EvaluateConfig) -> None:
    """The files of the command."""
    folder.mkdir(parents=True, exist_ok=True)
    seeds = {"stream": config.stream, "seed": config.seed, "episodes": [0, config.episodes - 1]}
    write_episodes(folder, table)
    write_results(folder, {"rows": rows, "paired": paired_rows(table)}, asdict(config), seeds)
