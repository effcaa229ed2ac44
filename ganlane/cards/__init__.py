"""Realism cards from plain configs: which traffics drive, what they drive, and where the tables go.

1. :mod:`ganlane.cards.traffics`: who drives, and from which scenes.
2. :mod:`ganlane.cards.driving`: recorded or spawned starts, I-80, long runs.
3. :mod:`ganlane.cards.card`: all of it, as the numbers that are kept.
4. :mod:`ganlane.cards.output`: tables, documents, figures, and the file that ships.

What is measured, and how, is in :mod:`ganlane.evaluation.realism`.
"""

from ganlane.cards.card import Card, drive_card
from ganlane.cards.driving import scenes_path
from ganlane.cards.output import check_targets, draw, publish, show
from ganlane.cards.traffics import folds_of, makers_of

__all__ = ["Card", "check_targets", "draw", "drive_card", "folds_of", "makers_of", "publish", "scenes_path", "show"]
