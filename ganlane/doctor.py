"""``ganlane doctor``: what is installed and found, what is missing, and the command that mends it.

    ganlane doctor

Prints versions, devices, threads, compiler, configuration, shipped weights (each is loaded), recordings, cache, run
folders and extras. Nothing is written. What is MISSING is needed; what is absent serves further purposes only.

exit status: 0 all that is needed is there, 1 something needed is missing, 2 a mistake on the command line
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from ganlane._version import __version__

NEEDED_IS_MISSING = 1
USER_ERROR = 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if {"-h", "--help"} & set(arguments):
        print((__doc__ or "").strip())
        return 0
    if arguments:
        print(f"ganlane doctor: {arguments[0]}: it takes no keys; run ganlane doctor alone.", file=sys.stderr)
        return USER_ERROR
    from ganlane.diagnosis import examine, missing, report

    found = examine()
    print(f"ganlane {__version__}\n\n{report(found)}")
    return NEEDED_IS_MISSING if missing(found) else 0


if __name__ == "__main__":
    sys.exit(main())
