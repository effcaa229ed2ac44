"""``ganlane realism``: how close a traffic comes to recorded driving, as JSON, table and figures.

    ganlane realism traffic=gan_calibrated
    ganlane realism traffic=gan data.path=recordings.csv 'against=[idm_mobil,gan_calibrated]'
    ganlane realism traffic=idm traffic._target_=my.module.MyTraffic vehicle_km=100
    ganlane realism traffic=gan_calibrated scenes=all report=docs/realism.md figures=docs/figures
    ganlane realism traffic=idm quick=true

Writes results.json, distributions.png, distances.png and drift.png into its run folder. Without recordings on the
machine it uses the histograms that ship, and says so.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from ganlane.config.app import run_command
from ganlane.config.realism import RealismConfig


def realism(config: RealismConfig, folder: Path) -> str:
    """Drive, measure, print, draw, keep."""
    from ganlane.build import set_threads
    from ganlane.cards import check_targets, draw, drive_card, publish, scenes_path, show
    from ganlane.evaluation import write_results
    from ganlane.evaluation.realism import card_text

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


if __name__ == "__main__":
    sys.exit(main())
