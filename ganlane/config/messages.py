"""Errors of Hydra, OmegaConf and the file system as one sentence: the value, what was expected, what to do.

A refused connection or a lost process is an OSError too, but not one that a user can fix: it keeps its traceback.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from ganlane.errors import UserError
from ganlane.parameters import did_you_mean

#: Errors of Hydra and OmegaConf for an invalid configuration.
CONFIG_ERRORS = (HydraException, OmegaConfBaseException)
#: Errors while values are read; a whole number of hundreds of digits raises OverflowError.
VALUE_ERRORS = (*CONFIG_ERRORS, OverflowError)

#: OmegaConf's names of types, in words.
_TYPES = {"Integer": "a whole number", "Float": "a number", "bool": "true or false", "String": "a text"}
_HELP = "run the command with --help to see all keys"
_ROOM = "make room there, or write to another disk"
_RIGHTS = "check the permissions, or name a place where you may write"
_PATH = "check the path"
_LATER = "close other programs and run the command again"

#: Advice by error number.
ADVICE = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), _ROOM),
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), _RIGHTS),
    **dict.fromkeys((errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENOTEMPTY), _PATH),
    **dict.fromkeys((errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL, errno.ENXIO, errno.ENODEV), _PATH),
    **dict.fromkeys((errno.EBUSY, errno.ETXTBSY, errno.EMFILE, errno.ENFILE, errno.ENOMEM), _LATER),
    errno.EIO: "the disk does not work as it should; check it",
    errno.ESTALE: "the network drive is gone; mount it again",
}


def sentence(error: BaseException) -> str:
    """The message for the user."""
    if isinstance(error, UserError):
        return _one_line(error) + "."
    if isinstance(error, MissingConfigException):  # an OSError, too
        return _missing_option(error)
    if isinstance(error, OSError):
        return file_sentence(error)
    if isinstance(error, OverrideParseException):
        return f"{error.override}: not of the form key=value; quote values with spaces or brackets, {_HELP}."
    if isinstance(error, OverflowError):
        key = re.search(r"full_key: (\S+)", str(error))
        return f"{key[1] if key else 'one of the numbers'}: too large; give a number of fewer digits."
    found = error if isinstance(error, OmegaConfBaseException) else error.__cause__
    return _value(found) if isinstance(found, OmegaConfBaseException) else _composition(error)


def _one_line(error: BaseException | str) -> str:
    """The text without line breaks and final full stop."""
    return re.sub(r"\s+", " ", str(error)).strip().rstrip(".")


def _missing_option(error: MissingConfigException) -> str:
    """Message for ``group=name`` without such an option."""
    group, _, name = (error.missing_cfg_file or "").rpartition("/")
    known = sorted(option for option in error.options or () if not option.endswith("_schema"))
    if not known:
        return f"{_one_line(error)}; {_HELP}."
    return f"{group}={name}: no such option{did_you_mean(name, known)}; choose one of {', '.join(known)}."


def _composition(error: BaseException) -> str:
    """Message for options that do not fit the command."""
    text = _one_line(error)
    group = re.search(r"Could not override '([^']+)'", text)
    if group:
        hint = f" (did you mean {group[1]}s=[NAME,NAME]?)" if group[1] in ("agent", "traffic") else ""
        return f"{group[1]}: not an option of this command{hint}; {_HELP}."
    sweep = re.search(r"Ambiguous value for argument '([^']+)'", text)
    if sweep:
        return f"{sweep[1]}: several values; write key=[a,b] for a list, or add -m for a sweep."
    return f"{text}; {_HELP}."


def _value(error: OmegaConfBaseException) -> str:
    """Message for an unknown key, a value of the wrong type, or another error of OmegaConf."""
    key = (error.full_key or str(error.key or "")).removeprefix(".")
    if isinstance(error, (ConfigKeyError, ConfigAttributeError)):
        return _unknown_key(key, error)
    text = _one_line(error.msg or str(error))
    value = re.search(r"[Vv]alue '(.*?)' ", text)
    wanted = re.search(r"could not be converted to (\w+)", text) or re.search(r"not a valid (bool)", text)
    if wanted and value and wanted[1] in _TYPES:
        return f"{key}={_typed(value[1])}: expected {_TYPES[wanted[1]]}; {_HELP}."
    if "not Optional" in text or "non-optional" in text:
        return f"{key}=null: a value is needed; {_HELP}."
    if "ListConfig" in text:
        return f"{key}: expected a list in brackets, for instance {key}=[...]; {_HELP}."
    if "not a subclass" in text or text.startswith("Cannot assign"):
        return f"{key}: holds keys of its own; give {key}.NAME=VALUE; {_HELP}."
    return f"{key}: {text.partition(' full_key')[0]}; {_HELP}."


def _typed(value: str) -> str:
    """The value as typed on the command line."""
    return {"None": "null", "True": "true", "False": "false"}.get(value, value)


def _unknown_key(key: str, error: OmegaConfBaseException) -> str:
    if key.rpartition(".")[0].endswith(".parameters"):
        return f"{key}: to be added with +; write +{key}=VALUE."
    known = sorted(map(str, error.parent_node.keys())) if OmegaConf.is_dict(error.parent_node) else []
    return unknown_key(key, [other for other in known if other != "hydra"])


def unknown_key(key: str, known: Sequence[str], of: str | None = None) -> str:
    """Message for a ``key`` that is not ``known``; ``of`` replaces the name of its parent in the sentence."""
    parent, _, name = key.rpartition(".")
    where = of or (f"{parent} has" if parent else "known are")
    listed = f"; {where} {', '.join(known)}" if known else f"; {_HELP}"
    return f"{key}: no such key{did_you_mean(name, known)}{listed}."


def is_users_matter(error: BaseException) -> bool:
    """Whether a user can fix the error: one about a path, a permission or a disk."""
    return isinstance(error, OSError) and error.errno in ADVICE


def file_sentence(error: OSError) -> str:
    """The path, what is wrong, and what to do."""
    number = error.errno or 0
    where = error.filename2 or error.filename or "a file or standard output"
    return f"{where}: {error.strerror or os.strerror(number)}; {ADVICE.get(number, _PATH)}."


@contextmanager
def numbered_refusals() -> Iterator[None]:
    """Turn errors of the file system that a library reports as text alone into OSErrors with their number.

    polars raises "No space left on device (os error 28)" in errors of several types, without number or file name.
    """
    try:
        yield
    except Exception as error:
        code = re.search(r"\(os error (\d+)\)", str(error))
        if code is None or getattr(error, "errno", None) is not None or isinstance(error, UserError):
            raise
        raise OSError(int(code[1]), os.strerror(int(code[1]))) from error
