"""``ganlane reproduce``: every driver on every traffic on the same episodes; the paper's tables and
figures from it.

    ganlane reproduce
    ganlane reproduce episodes=50 'traffics=[idm_mobil,gan]'
    'agents=[random_legal,mobil,agent_idm@all]' ganlane reproduce
    'runs=[outputs/train/SEED_0,outputs/train/SEED_1]' ganlane reproduce from=scratch

Writes results.json, report.html, crashes.json (for ``ganlane render crashes=FILE``), figures (PNG,
SVG) and a CSV behind each into its run folder. What was driven stays in ``cells``: a command that
was stopped goes on where it was, and one with other drivers drives those alone.

Modules:

- :mod:`ganlane.compare`: drives, cell by cell.
- :mod:`~ganlane.reproduce.report`: numbers and tables.
- :mod:`~ganlane.reproduce.figures`: the paper's figures and the picture of the matrix.
- :mod:`~ganlane.reproduce.crashes`: lists crashes, and drives them again.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from ganlane.config.run import run_command


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    given = sys.argv[1:] if arguments is None else arguments
    # ``from`` is a Python keyword, so no field of a dataclass can have this name.
    given = [
        f"source={argument[5:]}" if argument.startswith("from=") else argument for argument in given
    ]
    return run_command("reproduce", given)
