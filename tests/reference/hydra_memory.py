"""Hydra composes each choice of options once for a whole test session; keys are set, and refused,
by Hydra itself.

For tests of what a command says about a value: reading thirty YAML files three times per command
line takes longer than all the rest of a refusal. Tests of the composing itself do without
(``tests/config``).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.singleton import Singleton
from omegaconf import open_dict

from ganlane.config.command_line import VERSION_BASE
from ganlane.config.schemas import register
from ganlane.files import conf_folder

CONFIGS: dict[tuple[str, tuple[str, ...]], Any] = {}
LOAD = ConfigLoaderImpl.load_configuration


@contextmanager
def fresh_hydra() -> Iterator[None]:
    """Room for a Hydra while another one is at work."""
    state = copy(Singleton._instances.get(GlobalHydra))
    try:
        GlobalHydra.instance().clear()
        yield
    finally:
        if state is not None:
            Singleton._instances[GlobalHydra] = state


def composed(command: str, options: tuple[str, ...] = ()) -> Any:
    """As Hydra composes it with these options of groups, its own part included.

    Read from YAML once.
    """
    if (command, options) not in CONFIGS:
        register(command)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(ConfigLoaderImpl, "load_configuration", LOAD)
            with (
                fresh_hydra(),
                initialize_config_dir(str(conf_folder()), version_base=VERSION_BASE),
            ):
                CONFIGS[command, options] = compose(
                    command, overrides=list(options), return_hydra_config=True
                )
    return CONFIGS[command, options].copy()


def own_part(config: Any) -> Any:
    """Without what is Hydra's."""
    with open_dict(config):
        del config["hydra"]
    return config


def load_from_memory(self: Any, config_name: str, overrides: list[str], *_: Any, **__: Any) -> Any:
    """In place of Hydra's own, which reads thirty YAML files three times for a command line."""
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    chosen = [override for override in parsed if (conf_folder() / override.key_or_group).is_dir()]
    config = composed(config_name, tuple(str(override.input_line) for override in chosen))
    ConfigLoaderImpl._apply_overrides_to_config(
        [override for override in parsed if override not in chosen], config
    )
    config.hydra.overrides.task = [
        override.input_line for override in parsed if not override.is_hydra_override()
    ]
    config.hydra.runtime.cwd = str(Path.cwd())
    return config
