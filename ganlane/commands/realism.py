"""Make the realism card of a traffic."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from ganlane.config.recordings import RealismConfig
from ganlane.evaluation import write_results
from ganlane.realism.card import drive_card, scenes_path
from ganlane.realism.output import card_text, check_targets, draw, publish, show
from ganlane.torch_settings import set_threads


def realism(config: RealismConfig, folder: Path) -> str:
    """Make a card: drive, measure, print and save; the line that names its results."""
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
