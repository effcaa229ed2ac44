"""Composing and checking a configuration before anything is created on disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, open_dict

from ganlane.config.messages import CONFIG_ERRORS, sentence
from ganlane.config.nodes import made
from ganlane.config.overrides import parse, single_runs
from ganlane.config.store import register
from ganlane.errors import UserError
from ganlane.files import conf_folder

VERSION_BASE = "1.3"


@dataclass(frozen=True)
class Checked:
    """What is known before a command runs: the config of its (first) run, and where its results will go."""

    config: Any
    run_folder: Path
    sweep_folder: Path


def typed(composed: DictConfig) -> Any:
    """The root dataclass of a composed config, ranges checked.

    Raises:
        UserError: a value is of the wrong type or out of range.
    """
    try:
        return made(composed)
    except CONFIG_ERRORS as error:
        raise UserError(sentence(error)) from error


def check(command: str, overrides: Sequence[str], multirun: bool = False) -> Checked:
    """Compose and check every run that ``overrides`` mean.

    Args:
        command: name of the root config, for instance ``train``.
        overrides: as on the command line.
        multirun: whether commas stand for a sweep.

    Raises:
        UserError: an unknown key or option, a value of the wrong type or out of range.
    """
    register()
    try:
        parse(overrides)
        runs = single_runs(overrides, multirun)
        with initialize_config_dir(str(conf_folder()), version_base=VERSION_BASE, job_name=command):
            checked = [_check_one(command, run) for run in runs]
    except CONFIG_ERRORS as error:
        raise UserError(sentence(error)) from error
    return checked[0]


def _check_one(command: str, overrides: Sequence[str]) -> Checked:
    composed = compose(command, overrides=list(overrides), return_hydra_config=True)
    with open_dict(composed):
        composed.hydra.job.num = 0
        folders = [Path(str(composed.hydra[mode].dir)) for mode in ("run", "sweep")]
        del composed["hydra"]
    return Checked(typed(composed), *folders)
