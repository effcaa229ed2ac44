"""Measuring drivers: given episodes, honest intervals, one table, and a record of where it came from.

The path of a number: :func:`run_episodes` drives the episodes 0 to E - 1 and gives one row for each;
:func:`evaluation_rows` turns the rows of several agents and traffics into the evaluation's table, with
bootstrap intervals (:mod:`~ganlane.evaluation.statistics`), exact intervals for crashes
(:mod:`~ganlane.evaluation.counts`) and the normalised score (:mod:`~ganlane.evaluation.score`);
on recorded scenes crashes per km come from :func:`crashes_by_scene`, which resamples whole scenes;
:func:`paired_rows` compares the first driver with the others on the same episodes; :func:`text_table` and
:func:`paired_table` print them; :func:`write_results` and :func:`write_episodes` keep it. :func:`drive` keeps the
actions of its episodes, and :func:`replay` drives them again.
Traffics are compared with recorded driving in :mod:`ganlane.realism`.
"""

from ganlane.evaluation.by_scene import CrashesByScene, crashes_by_scene
from ganlane.evaluation.counts import clopper_pearson, poisson_interval, rate_per_1000_km
from ganlane.evaluation.episodes import run_episodes
from ganlane.evaluation.layout import paired_table, text_table
from ganlane.evaluation.paired import paired_rows
from ganlane.evaluation.provenance import code_version, machine, machine_sentence
from ganlane.evaluation.results import results_record, write_episodes, write_results
from ganlane.evaluation.rides import Ride, drive, replay
from ganlane.evaluation.score import NormalizedScore, normalized_percent
from ganlane.evaluation.statistics import (
    Estimate,
    interquartile_mean,
    mean_interval,
    paired_difference,
    probability_of_improvement,
)
from ganlane.evaluation.table import evaluation_rows

__all__ = [
    "CrashesByScene",
    "Estimate",
    "NormalizedScore",
    "Ride",
    "clopper_pearson",
    "code_version",
    "crashes_by_scene",
    "drive",
    "evaluation_rows",
    "interquartile_mean",
    "machine",
    "machine_sentence",
    "mean_interval",
    "normalized_percent",
    "paired_difference",
    "paired_rows",
    "paired_table",
    "poisson_interval",
    "probability_of_improvement",
    "rate_per_1000_km",
    "replay",
    "results_record",
    "run_episodes",
    "text_table",
    "write_episodes",
    "write_results",
]
