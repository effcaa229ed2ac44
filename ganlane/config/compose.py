"""Plain data from words: Hydra composes the YAML files of ``conf/``; the records check the result.

The files hold only what differs from the records and need no schema. Every ``key=value`` reaches
Hydra as ``++key=value``, and a key that no record has is refused by the record.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from copy import deepcopy
from functools import cache
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ganlane.errors import UserError
from ganlane.files import conf_folder
from ganlane.settings.record import merged, option

#: Hydra's defaults are those of this version, whichever is installed.
VERSION_BASE = "1.3"
_HELP = "run the command with --help to see all keys"
#: The keys of Hydra's own configuration that a command line may set, besides launcher and sweeper
#: and their parameters: most others name code that Hydra would import.
HYDRA_KEYS = ("hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir")
_HYDRA_PLUGIN = re.compile(r"hydra(/|\.)(launcher|sweeper)\b")
#: Keys that a command calls by another name, because ``agent=`` would choose an option of a group.
ALIASES = {
    "render": {"agent": "agents", "episode": "episodes"},
    "record": {"agent": "driver"},
}


def parsed(command: str, words: Sequence[str]) -> list[Override]:
    """The words of a command line by Hydra's grammar, as :func:`composed` takes them.

    Raises:
        UserError: a word is not of the form key=value, names no option, or would make Hydra import
            something.
    """
    for word in words:
        # Python reads bytes beyond the locale's characters as lone surrogates.
        if word != word.encode("utf-8", "ignore").decode():
            raise UserError(
                f"{word!a}: has characters that this locale does not know; set LC_ALL=C.UTF-8."
            )

    # Words without = are agents. A path may have an = in it, as the folders of a sweep do.
    bare = [word for word in words if "=" not in word or os.path.exists(word)]
    if command == "benchmark" and bare:
        others = [word for word in words if word not in bare]
        words = [*others, f"agents={json.dumps(bare)}"]

    # Hydra's own grammar, so that quotes, lists and sweeps mean what its users expect.
    meant = [_as_meant(command, word) for word in words]
    try:
        overrides = OverridesParser.create().parse_overrides(meant)
    except (ValueError, RecursionError) as error:  # limits of Python
        raise UserError(
            "a value of the command line: too long a number or too deep a list; shorten it."
        ) from error
    except HydraException as error:
        raise UserError(sentence(error)) from error
    for override in overrides:
        _check(override)
    return overrides


def _as_meant(command: str, word: str) -> str:
    """A word with the key that the record has.

    The traffic of a phase may be named alone, ``pretrain.traffic=gan``, or as Hydra mounts a group,
    ``traffic@pretrain.traffic=gan``; both become ``pretrain.traffic.name=gan``, so that keys of
    that traffic can be set beside it.
    """
    # Only the key is touched; Hydra reads the value.
    key, equals, value = word.partition("=")
    key = ALIASES.get(command, {}).get(key, key).removeprefix("traffic@")
    if key.endswith(".traffic") and re.fullmatch(r"[\w,]+", value) and value != "null":
        key = f"{key}.name"
    return f"{key}{equals}{value}"


def _is_group(key: str) -> bool:
    """Whether the key chooses among options, which are the files in a folder of its name."""
    return (conf_folder() / key).is_dir()


def _check(override: Override) -> None:
    """Refuse deletions, unknown options of a group, and keys of Hydra that import code."""
    key, word = override.key_or_group, override.input_line
    if override.is_delete():
        raise UserError(f"{word}: keys cannot be deleted; give {key}=null or leave it as it is.")
    if key.startswith("hydra"):
        if key not in HYDRA_KEYS and (not _HYDRA_PLUGIN.match(key) or "_target_" in str(word)):
            raise UserError(
                f"{key}: no such key here; of Hydra's configuration give {', '.join(HYDRA_KEYS)}, "
                "hydra/launcher=NAME, hydra.launcher.PARAMETER=... or the same of the sweeper."
            )
        # Hydra reads the file of this name, from another folder too
        if "/" in key and not str(override.value()).isidentifier():
            raise UserError(f"{word}: no such option; give a launcher's name, such as joblib.")
        return

    if not _is_group(key):
        return
    values = [override.value()]
    if override.is_sweep_override():
        values = list(override.sweep_iterator())
    for value in values:
        # Refused where there is no such option.
        option(key, value)


def for_hydra(overrides: Sequence[Override]) -> list[str]:
    """Words for Hydra: a key is set whether or not a file has it; a mapping replaces one.

    The last of several words with one key counts.
    """
    # Hydra refuses a group chosen twice; here the last word counts, as in a shell.
    last = {override.key_or_group: override for override in overrides}
    words: list[str] = []
    for key, override in last.items():
        word = str(override.input_line).lstrip("+")
        if _is_group(key) or key.startswith("hydra"):
            words.append(word)
            continue
        # Hydra would merge a mapping into that of an experiment.
        if "{" in word and not override.is_sweep_override():
            words.append(f"++{key}=null")
        # With ++ a key is set whether or not a file has it.
        words.append(f"++{word}")
    return words


def composed(command: str, overrides: Sequence[Override] = ()) -> dict[str, Any]:
    """Plain data of a command line.

    Raises:
        UserError: the options do not fit the command.
    """
    # A sweep, or a user's own application of Hydra, is running around this call: keep its state.
    outer = GlobalHydra.instance().hydra
    GlobalHydra.instance().hydra = None
    folder = str(conf_folder())
    try:
        with initialize_config_dir(folder, version_base=VERSION_BASE, job_name=command):
            config = compose(command, overrides=for_hydra(overrides))
            return OmegaConf.to_container(config, resolve=True)  # type: ignore[return-value]
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(sentence(error)) from error
    finally:
        GlobalHydra.instance().hydra = outer


# Cached, since the same files would be composed at every Python call.
@cache
def _defaults(command: str, *words: str) -> dict[str, Any]:
    """Plain data of a command line, shared by all calls: it must not be changed."""
    return composed(command, parsed(command, words))


def called(command: str, keys: Mapping[str, Any]) -> dict[str, Any]:
    """Plain data of a Python call: the command's own defaults with ``keys`` on top."""
    # An experiment is a set of defaults, so it is composed with the others.
    words = [f"experiment={keys['experiment']}"] if "experiment" in keys else []
    others = {name: value for name, value in keys.items() if name != "experiment"}
    return merged(deepcopy(_defaults(command, *words)), others)


def key_of(override: Override) -> str:
    """The key that a word replaces; an option by its name replaces all keys below it."""
    return str(override.key_or_group).removesuffix(".name")


def resumed(saved: Mapping[str, Any], overrides: Sequence[Override]) -> dict[str, Any]:
    """A saved run's data with what a command line names."""
    # Only what the command line names is taken from the new composition.
    config = OmegaConf.create(dict(saved))
    now = OmegaConf.create(composed("train", overrides))
    for override in overrides:
        key = key_of(override)
        if not key.startswith("hydra"):
            value = OmegaConf.select(now, key)
            OmegaConf.update(config, key, value, merge=False, force_add=True)
    return OmegaConf.to_container(config)  # type: ignore[return-value]


def sentence(error: BaseException) -> str:
    """An error of Hydra or OmegaConf in one sentence: what is wrong, what to do."""
    if isinstance(error, MissingConfigException):
        group, _, name = (error.missing_cfg_file or "").rpartition("/")
        return f"{group}={name}: no such option; {_HELP}."
    if isinstance(error, OverrideParseException):
        return (
            f"{error.override}: not of the form key=value; quote values with spaces or brackets, "
            f"{_HELP}."
        )

    # Hydra's errors have many lines; the part that says what is wrong is kept.
    text = " ".join(str(error).split())
    refused = re.search(r"Could not override '([^'@]+)[^']*'", text)
    if refused:
        key = refused[1]
        # Some commands take several of them.
        plural = f" (did you mean {key}s=[NAME,NAME]?)"
        hint = plural if key in ("agent", "traffic") else ""
        return f"{key}: not an option of this command{hint}; {_HELP}."

    ambiguous = re.search(r"Ambiguous value for argument '\+*([^']+)'", text)
    if ambiguous:
        return f"{ambiguous[1]}: several values; write [a,b] for a list, or add -m for a sweep."
    return f"{text.partition(' full_key')[0].rstrip('.')}; {_HELP}."
