"""The realism card: how close a traffic comes to recorded driving, and what it does when nobody starts it anew.

A card holds one traffic against recordings. Every traffic of a card drives from the same starts: the recorded scenes,
for as long as they were recorded. What comes out and the recordings go through the same measurement, and each
quantity gets the distance between both distributions, with an interval by scenes, on a scale that has two ends: one
half of the recordings against the other, and driving at random. Long runs without an ego stand beside it.

The modules in the order in which they are to be read:

1. **Driving.** :mod:`~ganlane.evaluation.realism.recordings` holds recorded scenes as arrays,
   :mod:`~ganlane.evaluation.realism.simulation` lets a traffic drive them. Who is there when is up to
   :mod:`~ganlane.evaluation.realism.script`, with which headway a driver starts to
   :mod:`~ganlane.evaluation.realism.headways`; the floors and a control are
   :mod:`~ganlane.evaluation.realism.drivers`.
2. **Measuring.** :mod:`~ganlane.evaluation.realism.quantities` measures trajectories, recorded or simulated;
   :mod:`~ganlane.evaluation.realism.distances` compares their histograms;
   :mod:`~ganlane.evaluation.realism.reference` keeps those of the recordings in a file that ships.
3. **Everybody from the same starts.** :mod:`~ganlane.evaluation.realism.driving` drives and measures,
   :mod:`~ganlane.evaluation.realism.fitting` fits desired speeds, :mod:`~ganlane.evaluation.realism.folds` keeps a
   traffic from scenes that it was fitted to; :mod:`~ganlane.evaluation.realism.starts` is all of it on recorded
   scenes, :mod:`~ganlane.evaluation.realism.spawned_scenes` what is left of it without recordings.
4. **The card.** :mod:`~ganlane.evaluation.realism.card` makes its rows, :mod:`~ganlane.evaluation.realism.i80` those
   of a site that no generator was fitted to.
5. **Long runs.** :mod:`~ganlane.evaluation.realism.long` drives them, :mod:`~ganlane.evaluation.realism.counters`
   looks on, :mod:`~ganlane.evaluation.realism.long_summary` sums up.
6. **Telling it.** :mod:`~ganlane.evaluation.realism.checks` answers with yes, no or undecided,
   :mod:`~ganlane.evaluation.realism.table` is the card as text, :mod:`~ganlane.evaluation.realism.document` puts it
   into a page.

The command is ``ganlane realism`` (:mod:`ganlane.realism` and :mod:`ganlane.cards`), the figures are in
:mod:`ganlane.view.realism`.
"""

from ganlane.evaluation.realism.card import floors_of, from_starts, quantity_rows, rows_of, verdict
from ganlane.evaluation.realism.checks import card_checks
from ganlane.evaluation.realism.counters import EventCounter, GuardMeter, watched
from ganlane.evaluation.realism.distances import (
    ceiling,
    distance,
    distance_difference,
    jensen_shannon,
    pooled_distance,
)
from ganlane.evaluation.realism.document import card_text, document_text, require_markers, update_document
from ganlane.evaluation.realism.drivers import ConstantVelocity, HeadwayIdm, RandomDriving
from ganlane.evaluation.realism.driving import FLOORS, Driven, Report, drive, drive_all, measure_recordings
from ganlane.evaluation.realism.fitting import desired_speeds, fit_excess
from ganlane.evaluation.realism.folds import Fold, check_cover, fold_weights
from ganlane.evaluation.realism.headways import balanced_headways, with_shown_headways
from ganlane.evaluation.realism.i80 import I80_FILES, i80_cards, i80_files, read_i80
from ganlane.evaluation.realism.long import LongRunParameters, long_run
from ganlane.evaluation.realism.long_summary import totals
from ganlane.evaluation.realism.quantities import QUANTITIES, UNITS, Measured, measure
from ganlane.evaluation.realism.recordings import Recording, frame_of, recorded_frame, recordings_of, stretches
from ganlane.evaluation.realism.reference import SHIPPED_REFERENCE, Reference, reference_of
from ganlane.evaluation.realism.simulation import Factory, StartOptions, drive_recordings
from ganlane.evaluation.realism.spawned_scenes import spawned_frame, spawned_starts
from ganlane.evaluation.realism.starts import Starts, recorded_starts

__all__ = [
    "FLOORS",
    "I80_FILES",
    "QUANTITIES",
    "SHIPPED_REFERENCE",
    "UNITS",
    "ConstantVelocity",
    "Driven",
    "EventCounter",
    "Factory",
    "Fold",
    "GuardMeter",
    "HeadwayIdm",
    "LongRunParameters",
    "Measured",
    "RandomDriving",
    "Recording",
    "Reference",
    "Report",
    "StartOptions",
    "Starts",
    "balanced_headways",
    "card_checks",
    "card_text",
    "ceiling",
    "check_cover",
    "desired_speeds",
    "distance",
    "distance_difference",
    "document_text",
    "drive",
    "drive_all",
    "drive_recordings",
    "fit_excess",
    "floors_of",
    "fold_weights",
    "frame_of",
    "from_starts",
    "i80_cards",
    "i80_files",
    "jensen_shannon",
    "long_run",
    "measure",
    "measure_recordings",
    "pooled_distance",
    "quantity_rows",
    "read_i80",
    "recorded_frame",
    "recorded_starts",
    "recordings_of",
    "reference_of",
    "require_markers",
    "rows_of",
    "spawned_frame",
    "spawned_starts",
    "stretches",
    "totals",
    "update_document",
    "verdict",
    "watched",
    "with_shown_headways",
]
