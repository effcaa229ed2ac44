"""``ganlane reproduce``: every driver on every traffic; the paper's tables and figures from it.

    ganlane reproduce
    ganlane reproduce episodes=50 'traffics=[idm_mobil,gan]'
    ganlane reproduce 'agents=[random_legal,mobil,agent_idm@all]'
    ganlane reproduce 'runs=[outputs/train/SEED_0,outputs/train/SEED_1]'
    ganlane reproduce from=scratch

All drivers drive the same episodes. Writes results.json, report.html, crashes.json (for ``ganlane
render crashes=FILE``), figures (PNG, SVG) and a CSV behind each into its run folder. What was
driven stays in ``cells``: a command that was stopped goes on where it was, and one with other
drivers drives those alone.

Modules:

- :mod:`~ganlane.reproduce.cells`: drives, cell by cell (:mod:`ganlane.compare`).
- :mod:`~ganlane.reproduce.report`: numbers, tables and the page.
- :mod:`~ganlane.reproduce.figures`: the paper's figures and the picture of the matrix.
- :mod:`~ganlane.reproduce.crashes`: lists crashes, and drives them again.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from ganlane.config.run import run_command


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    words = sys.argv[1:] if arguments is None else arguments
    # ``from`` is a Python keyword, so no field of a dataclass can have this name.
    return run_command(
        "reproduce",
        [f"source={word[5:]}" if word.startswith("from=") else word for word in words],
    )
