"""The command line: flags, overrides, the runs of a sweep, their checked configurations.

Errors as one sentence.
"""

from __future__ import annotations

import re
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any, NoReturn, get_args, get_origin, get_type_hints

from hydra import compose, initialize_config_dir
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType, Quote, QuotedString
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, open_dict
from omegaconf.errors import OmegaConfBaseException

from ganlane.config.schemas import (
    HELP,
    SCHEMAS,
    SUFFIX,
    made,
    one_line,
    options_of,
    register,
    unknown_key,
    value_sentence,
)
from ganlane.errors import UserError, file_sentence
from ganlane.files import conf_folder
from ganlane.parameters import did_you_mean

VERSION_BASE = "1.3"
#: Errors of Hydra and OmegaConf for an invalid configuration.
CONFIG_ERRORS = (HydraException, OmegaConfBaseException)
#: Errors while values are read; a whole number of hundreds of digits raises OverflowError.
VALUE_ERRORS = (*CONFIG_ERRORS, OverflowError)
#: The keys of Hydra's own configuration that a command line may set, besides launcher and sweeper
#: and their parameters: most others name code that Hydra would import.
HYDRA_KEYS = ("hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir", "hydra.job.num")
HYDRA_PLUGINS = ("launcher", "sweeper")
#: Keys that a command calls by another name, because ``agent=`` would choose an option of the group
#: ``agent``.
ALIASES = {"render": {"agent": "driver"}, "record": {"agent": "driver"}}
#: A number with an exponent, and the functions of a sweep.
_EXPONENT, _SWEPT = (
    r"(?<![\w.])\d+(?:\.\d+)?[eE]\+?\d{1,2}(?![\w.])",
    r"(choice|range|interval|glob|sort|shuffle|tag)\(.*\)",
)


def parse_arguments(command: str, arguments: Sequence[str]) -> Namespace:
    """Hydra's flags and the overrides of a command.

    Raises:
        UserError: an unknown flag, or one that would have no effect; one of those
            (experimental_rerun) would load a pickle.
    """
    parser = get_args_parser()
    parser.add_argument("--help-all", action="store_true")

    def refuse(message: str) -> NoReturn:
        raise UserError(f"{message}; run the command with --help or --hydra-help to see the flags.")

    parser.error = refuse  # type: ignore[method-assign]
    flags = parser.parse_args(list(arguments))
    for name in ("config_path", "config_name", "config_dir", "experimental_rerun"):
        if getattr(flags, name) is not None:
            raise UserError(
                f"--{name.replace('_', '-')}: ganlane has its own configuration; give key=value instead."
            )
    for name in ("resolve", "package"):
        if getattr(flags, name) and flags.cfg is None and not flags.help:
            raise UserError(
                f"--{name}: it goes with --cfg alone, which shows the configuration; add --cfg job."
            )
    flags.overrides = [as_meant(command, override, flags.multirun) for override in flags.overrides]
    return flags


def as_meant(command: str, override: str, multirun: bool = False) -> str:
    """An override in Hydra's syntax: ``agents=mobil`` as a list of one, ``1e5`` for a whole number
    as ``100000``.

    In the value of a list commas separate entries, which need no quotes; in a sweep they separate
    runs.
    """
    key, equals, value = override.partition("=")
    key = ALIASES.get(command, {}).get(key, key)
    kinds = _kinds(SCHEMAS[""].get(command), key.split("."))
    if int in kinds:
        value = re.sub(_EXPONENT, _whole, value)
    if kinds & {list, tuple} and value != "null" and not re.match(rf"[\[{{$]|$|{_SWEPT}", value):
        entries = (
            value.split(",")
            if int in kinds or float in kinds or value[0] in "'\""
            else map(quoted, value.split(","))
        )
        value = "],[".join(entries) if multirun else ",".join(entries)
        value = f"[{value}]"
    return f"{key}{equals}{value}"


def _whole(number: re.Match[str]) -> str:
    exact = Decimal(number[0])
    return str(int(exact)) if exact == int(exact) else number[0]


def _kinds(hint: Any, path: Sequence[str]) -> set[Any]:
    """The types allowed at ``path`` below ``hint``, including those inside unions and lists and of
    subclasses.
    """
    inner = set().union(*(_kinds(each, path) for each in get_args(hint)))
    if not path:
        return {get_origin(hint) or hint, *inner}
    if get_origin(hint) is dict:
        return _kinds(get_args(hint)[1], path[1:])
    if not is_dataclass(hint):
        return inner
    found = _kinds(get_type_hints(hint).get(path[0]), path[1:])
    return found.union(*(_kinds(kind, path) for kind in type.__subclasses__(hint)))  # type: ignore[arg-type]


def quoted(value: object) -> str:
    """``value`` quoted for Hydra: ``it's`` becomes ``'it\\'s'``."""
    return QuotedString(str(value), Quote.single).with_quotes()


def parse(overrides: Sequence[str]) -> list[Override]:
    """Parse overrides by Hydra's grammar, and refuse some.

    Raises:
        UserError: an override would add or delete keys, names no option, or would make Hydra import
            something.
        hydra.errors.OverrideParseException: one is not of the form key=value.
    """
    try:
        parsed = OverridesParser.create().parse_overrides(list(overrides))
    except (ValueError, RecursionError) as error:  # limits of Python
        longest = max(overrides, key=len)
        raise UserError(
            f"{longest:.60}...: too long a number or too deep a list; give a shorter value."
        ) from error
    for override in parsed:
        if of_hydra(override):
            _refuse_hydras(override)
        else:
            _refuse_own(override)
    return parsed


def of_hydra(override: Override) -> bool:
    """Whether an override changes Hydra's own configuration."""
    return re.match(r"hydra\b", override.key_or_group) is not None or (
        override.package or ""
    ).startswith("hydra")


def _refuse_hydras(override: Override) -> None:
    """Refuse keys by which Hydra would import and call the ``_target_`` of a callback, launcher or
    log handler.
    """
    key, value = override.key_or_group, override.value()
    group = any(key == f"hydra/{plugin}" for plugin in HYDRA_PLUGINS) and re.fullmatch(
        r"\w+", str(value)
    )
    if (
        override.type == OverrideType.CHANGE
        and override.package is None
        and (group or key in HYDRA_KEYS)
    ):
        return
    parameter = (
        any(key.startswith(f"hydra.{plugin}.") for plugin in HYDRA_PLUGINS)
        and not override.is_delete()
    )
    if parameter and "_target_" not in {*key.split("."), *leaves(value)}:
        return
    raise UserError(
        f"{override.input_line}: {key}: no such key here; of Hydra's configuration give {', '.join(HYDRA_KEYS)}, "
        "hydra/launcher=NAME, hydra.launcher.PARAMETER=... or the same of the sweeper."
    )


def leaves(value: object) -> Iterator[str]:
    """All texts in a parsed value: itself, or the entries of lists and mappings, keys included."""
    if isinstance(value, Mapping):
        value = [*value, *value.values()]
    if isinstance(value, list):
        for each in value:
            yield from leaves(each)
    else:
        yield str(value)


def _refuse_own(override: Override) -> None:
    """Refuse what bypasses the schemas.

    That is ``+key``, ``++key`` and ``~key``, but for the free parameters of a target, and a value
    of a group that is not the name of one option, such as a path to a file elsewhere.
    """
    key, line = override.key_or_group, str(override.input_line)
    if override.is_delete():
        raise UserError(f"{line}: keys cannot be deleted; give {key}=null or leave it as it is.")
    if override.type != OverrideType.CHANGE and ".parameters." not in key:
        raise UserError(
            f"{line}: keys cannot be added; write {key}=... without + if it exists "
            "(+ is for traffic.parameters.NAME alone)."
        )
    named = override.is_sweep_override() or isinstance(override.value(), str)
    if (conf_folder() / key).is_dir() and (
        not named or re.search(r"[/\\]|\.\.", line.partition("=")[2])
    ):
        raise UserError(
            f"{line}: expected the name of one option; choose one of {', '.join(options_of(key))}."
        )


def refuse_unknown_keys(command: str, overrides: Sequence[Override]) -> None:
    """Report a mistyped key before registering and composing, which take 0.3 s.

    Keys that only some options of a group have are left to composing.

    Raises:
        UserError: an unknown key.
    """
    options = [kind for schemas in SCHEMAS.values() for kind in schemas.values()]
    for override in overrides:
        key = override.key_or_group
        if (
            override.type != OverrideType.CHANGE
            or of_hydra(override)
            or (conf_folder() / key).is_dir()
        ):
            continue
        kind, path = SCHEMAS[""][command], key.split(".")
        for depth, name in enumerate(path, 1):
            kinds = [kind] if depth == 1 else _with_subclasses(kind)
            known = (
                {field.name for each in kinds for field in fields(each)}
                if is_dataclass(kind)
                else set()
            )
            if not known or (len(kinds) > 1 and kind not in options):
                break
            if name not in known:
                of = "its options have" if len(kinds) > 1 else None
                raise UserError(unknown_key(".".join(path[:depth]), sorted(known), of))
            hint = get_type_hints(kind).get(name)
            kind = next(filter(is_dataclass, get_args(hint)), hint)


def _with_subclasses(kind: Any) -> list[Any]:
    """A class and all of its subclasses."""
    below: list[Any] = type.__subclasses__(kind) if isinstance(kind, type) else []
    return [kind, *(each for child in below for each in _with_subclasses(child))]


def without_repetitions(overrides: Sequence[str]) -> list[str]:
    """The last override of each key; Hydra refuses to choose an option twice."""
    last = {
        override.get_key_element().lstrip("+"): str(override.input_line)
        for override in parse(overrides)
    }
    return list(last.values())


def with_shares_replaced(overrides: Sequence[str]) -> list[str]:
    """The overrides, with a null before each ``traffic.shares=...``, which Hydra would merge into
    an experiment's.
    """
    replaced = []
    for override in parse(overrides):
        key = override.key_or_group
        replaced += [f"{key}=null"] if key.endswith("traffic.shares") else []
        replaced.append(str(override.input_line))
    return replaced


def single_runs(overrides: Sequence[str], multirun: bool) -> list[list[str]]:
    """The overrides of every run: one, or all combinations of a sweep."""
    if not multirun:
        return [list(overrides)]
    parsed = [override for override in parse(overrides) if not of_hydra(override)]
    batches = BasicSweeper.split_arguments(parsed, max_batch_size=None)
    return [list(run) for batch in batches for run in batch]


@dataclass(frozen=True)
class Checked:
    """The checked config of a command's (first) run, and the folders of its results."""

    config: Any
    composed: DictConfig
    run_folder: Path
    sweep_folder: Path


def typed(composed: DictConfig) -> Any:
    """The root dataclass of a composed config, ranges checked.

    Raises:
        UserError: a value is of the wrong type or out of range.
    """
    try:
        return made(composed)
    except VALUE_ERRORS as error:
        raise UserError(sentence(error)) from error


def check(command: str, overrides: Sequence[str], multirun: bool = False) -> Checked:
    """Compose and check every run that ``overrides``, as on the command line, mean; return the
    first.

    Raises:
        UserError: an unknown key or option, a value of the wrong type or out of range.
    """
    try:
        refuse_unknown_keys(command, parse(overrides))
        register(command)
        runs = single_runs(overrides, multirun)
        with initialize_config_dir(str(conf_folder()), version_base=VERSION_BASE, job_name=command):
            checked = [_check_one(command, run) for run in runs]
    except VALUE_ERRORS as error:
        raise UserError(sentence(error)) from error
    return checked[0]


def _check_one(command: str, overrides: Sequence[str]) -> Checked:
    try:
        composed = compose(
            command, overrides=with_shares_replaced(overrides), return_hydra_config=True
        )
    except AssertionError as error:  # OmegaConf's own check
        below = [key for key in (each.partition("=")[0] for each in overrides) if "." in key]
        nested = ", ".join(key for key in below if not key.startswith("hydra."))
        raise UserError(
            f"{nested}: a key below one that is null; choose an option first, as in traffic@pretrain.traffic=gan."
        ) from error
    with open_dict(composed):
        composed.hydra.job.num = 0
        folders = [Path(str(composed.hydra[mode].dir)) for mode in ("run", "sweep")]
        del composed["hydra"]
    return Checked(typed(composed), composed, *folders)


def sentence(error: BaseException) -> str:
    """An error of Hydra, OmegaConf or the file system in one sentence.

    The value, what was expected, what to do.
    """
    if isinstance(error, UserError):
        return one_line(error) + "."
    if isinstance(error, MissingConfigException):  # an OSError, too
        group, _, name = (error.missing_cfg_file or "").rpartition("/")
        known = sorted(option for option in error.options or () if not option.endswith(SUFFIX))
        if not known:
            return f"{one_line(error)}; {HELP}."
        return f"{group}={name}: no such option{did_you_mean(name, known)}; choose one of {', '.join(known)}."
    if isinstance(error, OSError):
        return file_sentence(error)
    if isinstance(error, OverrideParseException):
        return f"{error.override}: not of the form key=value; quote values with spaces or brackets, {HELP}."
    if isinstance(error, OverflowError):
        key = re.search(r"full_key: (\S+)", str(error))
        return (
            f"{key[1] if key else 'one of the numbers'}: too large; give a number of fewer digits."
        )
    found = error if isinstance(error, OmegaConfBaseException) else error.__cause__
    return (
        value_sentence(found) if isinstance(found, OmegaConfBaseException) else _composition(error)
    )


def _composition(error: BaseException) -> str:
    """The sentence for options that do not fit the command."""
    text = one_line(error)
    group = re.search(r"Could not override '([^']+)'", text)
    if group:
        hint = (
            f" (did you mean {group[1]}s=[NAME,NAME]?)" if group[1] in ("agent", "traffic") else ""
        )
        return f"{group[1]}: not an option of this command{hint}; {HELP}."
    sweep = re.search(r"Ambiguous value for argument '([^']+)'", text)
    if sweep:
        return f"{sweep[1]}: several values; write key=[a,b] for a list, or add -m for a sweep."
    return f"{text}; {HELP}."
