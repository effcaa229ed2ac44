"""How close ``human`` comes to recorded driving where every scene is driven by a fit that never saw
it.

    ganlane train_generator generator=human 'data.held_out=[us101-a]'
    ganlane train_generator generator=human 'data.held_out=[us101-d]'
    python -m benchmarks.fold_card RUN/generator_human.safetensors RUN/generator_human.safetensors

Each file drives the scenes that it was not fitted to, beside the rivals, from the same starts; its
desired speeds are fitted on the others. The table is of all these scenes together, the intervals
are over scenes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.script import make_parser, markdown, run_script
from ganlane.commands.realism import drive_from_starts, factories_on_card, scenes_path
from ganlane.config.run import call_settings
from ganlane.evaluation.table import Table, number, with_interval, with_sign
from ganlane.realism.card import card_rows
from ganlane.realism.measures import RESAMPLES, Measured
from ganlane.realism.starts import Starts
from ganlane.settings.recordings import RealismConfig
from ganlane.weights import load_weights

RIVALS = ("gan_calibrated", "idm_mobil")


def driven_by(file: Path) -> Starts:
    """The fit and its rivals in the scenes that it never saw."""
    held_out = load_weights(file, "generator")[1]["data"]["held_out"]
    keys = {
        "traffic": {"name": "human", "path": str(file)},
        "against": list(RIVALS),
        "data": {"held_out": held_out},
    }
    config: RealismConfig = call_settings("realism", keys)
    return drive_from_starts(config, factories_on_card(config), scenes_path(config))


def joined(parts: Sequence[Measured]) -> Measured:
    """The units of all parts, one after the other; quantiles are left out."""
    counts = {
        name: np.concatenate([part.counts[name] for part in parts]) for name in parts[0].counts
    }
    changes = sum(part.lane_changes for part in parts)
    return Measured(counts, {}, changes, sum(part.vehicle_km for part in parts))


def fold_card(options: argparse.Namespace) -> str:
    """Distances to recorded driving of all folds together, and lane changes."""
    folds = [driven_by(file) for file in options.weights]
    driven = {name: joined([fold.driven[name] for fold in folds]) for name in folds[0].driven}
    recorded = joined([fold.recorded for fold in folds])
    lines = []
    starts = replace(folds[0], driven=driven, recorded=recorded)
    for quantity, row in card_rows(starts, RESAMPLES).items():
        line = [quantity, with_interval(row, "distance"), number(row["ceiling"], 3)]
        for rival in row["against"].values():
            line += [with_interval(rival, "distance"), with_sign(rival, "difference", 3)]
        lines.append(line)
    rates = [
        f"{name} {with_interval(measured.summary(), 'per_vehicle_km', 2)}"
        for name, measured in {"recorded": recorded, **driven}.items()
    ]
    headings = ["distance to recorded", "human", "one half to the other"]
    for rival in RIVALS:
        headings += [rival, f"human minus {rival}"]
    notes = [f"Lane changes per vehicle-km: {', '.join(rates)}."]
    return markdown(Table("", headings, lines, notes=notes))


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("weights", nargs="+", type=Path)
    sys.exit(run_script(fold_card, parser.parse_args()))
