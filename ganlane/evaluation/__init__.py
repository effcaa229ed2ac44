# ruff: noqa: F401  (the names that other parts of the package and users import from here)
"""Measuring drivers: episodes, intervals, tables, and where the numbers come from.

:func:`run_episodes` drives the episodes 0 to E - 1 and gives one row for each;
:func:`evaluation_rows` turns the rows of several agents and traffics into the evaluation's table,
with 95 % intervals and the normalised score; :func:`paired_rows` compares the first driver with the
others on the same episodes; :func:`crashes_by_scene` resamples whole recorded scenes.
:func:`text_table` and :func:`paired_table` print, :func:`write_results` and :func:`write_episodes`
save. Traffics are compared with recorded driving in :mod:`ganlane.realism`.
"""

from ganlane.evaluation.episodes import run_episodes
from ganlane.evaluation.results import (
    code_version,
    machine,
    machine_sentence,
    write_episodes,
    write_results,
)
from ganlane.evaluation.rows import (
    crashes_by_scene,
    evaluation_rows,
    failed_episodes,
    normalized_percent,
    paired_rows,
)
from ganlane.evaluation.table import paired_table, text_table
