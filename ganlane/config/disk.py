"""What the file system refuses: which of it is the user's matter, as one sentence that says what to do.

A connection that is refused or a process that is gone is an OSError, too, but none that a user can mend: it keeps its
traceback.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager

from ganlane.errors import UserError

_ROOM = "make room there, or write to another disk"
_RIGHTS = "check the permissions, or name a place where you may write"
_PATH = "check the path"
_LATER = "close other programs and run the command again"

#: Error number to what to do.
ADVICE = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), _ROOM),
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), _RIGHTS),
    **dict.fromkeys((errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENOTEMPTY), _PATH),
    **dict.fromkeys((errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL, errno.ENXIO, errno.ENODEV), _PATH),
    **dict.fromkeys((errno.EBUSY, errno.ETXTBSY, errno.EMFILE, errno.ENFILE, errno.ENOMEM), _LATER),
    errno.EIO: "the disk does not work as it should; check it",
    errno.ESTALE: "the network drive is gone; mount it again",
}


def is_users_matter(error: BaseException) -> bool:
    """Whether the error is about a path, a place or a disk that the user can do something about."""
    return isinstance(error, OSError) and error.errno in ADVICE


def file_sentence(error: OSError) -> str:
    """The path, what is wrong, and what to do."""
    number = error.errno or 0
    where = error.filename2 or error.filename or "a file or standard output"
    return f"{where}: {error.strerror or os.strerror(number)}; {ADVICE.get(number, _PATH)}."


@contextmanager
def numbered_refusals() -> Iterator[None]:
    """Raise as an OSError with its number what a library tells in its text alone.

    polars says "No space left on device (os error 28)" in errors of several types, without a number or a name.
    """
    try:
        yield
    except Exception as error:
        told = re.search(r"\(os error (\d+)\)", str(error))
        if told is None or getattr(error, "errno", None) is not None or isinstance(error, UserError):
            raise
        raise OSError(int(told[1]), os.strerror(int(told[1]))) from error
