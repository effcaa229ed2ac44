"""The realism card, and its command: how close a traffic comes to recorded driving.

    ganlane realism traffic=gan_calibrated
    ganlane realism traffic=gan data.path=recordings.csv 'against=[idm_mobil,gan_calibrated]'
    ganlane realism traffic=idm traffic._target_=my.module.MyTraffic vehicle_km=100
    ganlane realism traffic=gan_calibrated scenes=all report=docs/realism.md figures=docs/figures
    ganlane realism traffic=idm quick=true

Writes results.json, distributions.png, distances.png and drift.png into its run folder. Without recordings on the
machine it uses the histograms that ship, and says so.

Every traffic of a card drives from the same starts: the recorded scenes, for as long as they were recorded. Simulated
and recorded trajectories go through the same measurement. Each quantity gets the distance between both distributions,
with an interval over scenes, on a scale with two ends: one half of the recordings against the other, and random
driving. Long runs without an ego show what a traffic does over minutes.

The modules, from the bottom up:

- :mod:`~ganlane.realism.recordings`: recorded scenes as arrays.
- :mod:`~ganlane.realism.measures`: what is measured of trajectories, and the distance of two distributions.
- :mod:`~ganlane.realism.references`: the histograms that ship, and reference drivers.
- :mod:`~ganlane.realism.replay_starts`: a traffic drives recorded scenes.
- :mod:`~ganlane.realism.long_runs`: long runs, and the events in them.
- :mod:`~ganlane.realism.starts`: every traffic from recorded or spawned starts, its desired speeds fitted, by folds
  where asked for.
- :mod:`~ganlane.realism.card`: drives a card; its numbers and checks.
- :mod:`~ganlane.realism.output`: tables, documents and figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from ganlane.config.app import run_command
from ganlane.config.recordings import RealismConfig


def realism(config: RealismConfig, folder: Path) -> str:
    """Make a card: drive, measure, print and save; the line that names its results."""
    from ganlane.evaluation import write_results
    from ganlane.realism.card import drive_card, scenes_path
    from ganlane.realism.output import card_text, check_targets, draw, publish, show
    from ganlane.runtime import set_threads

    config = config.shortened()
    set_threads(config.threads)
    path = scenes_path(config)
    check_targets(config, path)
    card = drive_card(config, path)
    drawn, numbers = draw(card, folder), card.numbers()
    if config.publish:
        publish(card.starts)
    show(config, folder, card_text(numbers, card.long_runs), numbers, drawn)
    seeds = {"stream": "report", "seed": config.seed}
    return f"results: {write_results(folder, numbers, asdict(config), seeds)}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    return run_command("realism", realism, arguments)
