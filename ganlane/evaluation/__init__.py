"""Measuring drivers: given episodes, intervals, tables, and a record of where the numbers come
from.

:func:`run_episodes` drives the episodes 0 to E - 1 and gives one row for each;
:func:`evaluation_rows` turns the rows of several agents and traffics into the evaluation's table,
with 95 % intervals and the normalised score; :func:`paired_rows` compares the first driver with the
others on the same episodes; :func:`crashes_by_scene` resamples whole recorded scenes.
:func:`text_table` and :func:`paired_table` print, :func:`write_results` and :func:`write_episodes`
save. :func:`roll_out` records the actions of its episodes, :func:`replay` drives them again.
Traffics are compared with recorded driving in :mod:`ganlane.realism`.
"""

from ganlane.evaluation.episodes import Rollout, replay, roll_out, run_episodes
from ganlane.evaluation.results import (
    code_version,
    machine,
    machine_sentence,
    write_episodes,
    write_results,
)
from ganlane.evaluation.rows import (
    CrashesByScene,
    NormalizedScore,
    crashes_by_scene,
    evaluation_rows,
    failed_episodes,
    normalized_percent,
    paired_rows,
)
from ganlane.evaluation.statistics import (
    Estimate,
    clopper_pearson,
    mean_interval,
    paired_difference,
    poisson_interval,
)
from ganlane.evaluation.table import paired_table, text_table

__all__ = [
    "CrashesByScene",
    "Estimate",
    "NormalizedScore",
    "Rollout",
    "clopper_pearson",
    "code_version",
    "crashes_by_scene",
    "evaluation_rows",
    "failed_episodes",
    "machine",
    "machine_sentence",
    "mean_interval",
    "normalized_percent",
    "paired_difference",
    "paired_rows",
    "paired_table",
    "poisson_interval",
    "replay",
    "roll_out",
    "run_episodes",
    "text_table",
    "write_episodes",
    "write_results",
]
