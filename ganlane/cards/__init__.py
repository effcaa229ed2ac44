"""Realism cards from plain configs: which traffics drive, what they drive, and where the tables go.

:func:`makers_of` and :func:`folds_of` say who drives from which scenes (:mod:`ganlane.cards.traffics`);
:func:`drive_from_starts`, :func:`i80_beside` and :func:`long_runs` let them drive (:mod:`ganlane.cards.driving`);
:mod:`ganlane.cards.output` prints, draws and writes into documents. What is measured, and how, is in
:mod:`ganlane.evaluation.realism`.
"""

from ganlane.cards.driving import drive_from_starts, i80_beside, long_runs, scenes_path
from ganlane.cards.output import check_targets, command_line, draw, publish, show
from ganlane.cards.traffics import PRESETS, folds_of, makers_of

__all__ = [
    "PRESETS",
    "check_targets",
    "command_line",
    "draw",
    "drive_from_starts",
    "folds_of",
    "i80_beside",
    "long_runs",
    "makers_of",
    "publish",
    "scenes_path",
    "show",
]
