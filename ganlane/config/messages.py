"""Hydra's and OmegaConf's errors as one sentence that names the value, what was expected and what to do."""

from __future__ import annotations

import re
from collections.abc import Iterable

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import OmegaConf
from omegaconf.errors import ConfigKeyError, OmegaConfBaseException

from ganlane.config.checks import did_you_mean
from ganlane.errors import UserError

#: OmegaConf's names of types in words.
_TYPES = {
    "Integer": "a whole number",
    "Float": "a number",
    "Boolean": "true or false",
    "String": "a text",
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "str": "a text",
}
_HELP = "run the command with --help to see all keys"


def as_user_error(error: Exception) -> UserError:
    """What to tell the user about an error of Hydra or OmegaConf."""
    cause = error.__cause__
    if isinstance(error, MissingConfigException):
        return UserError(_missing_option(error))
    if isinstance(error, OverrideParseException):
        return UserError(
            f"{error.override}: not of the form key=value; quote values with spaces or brackets, {_HELP}."
        )
    if isinstance(error, OmegaConfBaseException):
        return UserError(_omegaconf(error))
    if isinstance(cause, OmegaConfBaseException):
        return UserError(_omegaconf(cause))
    return UserError(_one_line(error) + f"; {_HELP}.")


def _one_line(error: Exception) -> str:
    """The error's text without line breaks and final stop."""
    return re.sub(r"\s+", " ", str(error)).strip().rstrip(".")


def option_names(options: Iterable[str] | None) -> list[str]:
    """Names that a user may choose: schemas and Hydra's own file are not among them."""
    return sorted(name for name in options or () if not name.endswith("_schema") and name != "hydra_run")


def _missing_option(error: MissingConfigException) -> str:
    """``group=name`` without such an option."""
    group, _, name = (error.missing_cfg_file or "").rpartition("/")
    known = option_names(error.options)
    if not known:
        return f"{_one_line(error)}; {_HELP}."
    return f"{group}={name}: no such option{did_you_mean(name, known)}; choose one of {', '.join(known)}."


def _omegaconf(error: OmegaConfBaseException) -> str:
    """An unknown key, a value of the wrong type, or whatever else OmegaConf found."""
    key = (error.full_key or str(error.key or "")).removeprefix(".")
    if isinstance(error, ConfigKeyError) or error.__class__.__name__ == "ConfigAttributeError":
        return _unknown_key(key, error)
    text = (error.msg or str(error)).splitlines()[0]
    wanted = re.search(r"could not be converted to (\w+)", text) or re.search(r"field of type '(\w+)'", text)
    value = re.search(r"[Vv]alue '(.*?)'", text)
    if wanted and value and wanted[1] in _TYPES:
        return f"{key}={_typed(value[1])}: expected {_TYPES[wanted[1]]}; {_HELP}."
    if "ListConfig" in text:
        return f"{key}: expected a list in brackets, for instance {key}=[...]; {_HELP}."
    if "MISSING" in text or "Missing mandatory" in text:
        return f"{key}: a value is missing; give {key}=VALUE."
    return f"{key}: {_one_line(Exception(text))}; {_HELP}."


def _typed(value: str) -> str:
    """As one types it on the command line."""
    return {"None": "null", "True": "true", "False": "false"}.get(value, value)


def _unknown_key(key: str, error: OmegaConfBaseException) -> str:
    parent, _, name = key.rpartition(".")
    known = sorted(map(str, error.parent_node.keys())) if OmegaConf.is_dict(error.parent_node) else []
    known = [other for other in known if other != "hydra"]
    where = f"{parent} has" if parent else "known are"
    listed = f"; {where} {', '.join(known)}" if known else f"; {_HELP}"
    return f"{key}: no such key{did_you_mean(name, known)}{listed}."


#: What Hydra and OmegaConf raise for a configuration that will not do.
CONFIG_ERRORS = (HydraException, OmegaConfBaseException)
