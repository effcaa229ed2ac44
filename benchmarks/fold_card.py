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
from functools import reduce
from pathlib import Path

import numpy as np

from benchmarks.script import make_parser, markdown, run_script
from ganlane.commands.realism import drive_from_starts, factories_on_card, scenes_path
from ganlane.config.run import call_settings
from ganlane.evaluation.table import Table, number, with_interval, with_sign
from ganlane.realism.card import quantity_rows
from ganlane.realism.measures import Measured
from ganlane.settings.recordings import RealismConfig
from ganlane.weights import load_weights

RIVALS = ("gan_calibrated", "idm_mobil")


def driven_by(file: Path) -> dict[str, Measured]:
    """What the fit, its rivals and recorded drivers do in the scenes that it never saw."""
    held_out = load_weights(file, "generator")[1]["data"]["held_out"]
    keys = {
        "traffic": {"name": "human", "path": str(file)},
        "against": list(RIVALS),
        "data": {"held_out": held_out},
    }
    config: RealismConfig = call_settings("realism", keys)
    starts = drive_from_starts(config, factories_on_card(config), scenes_path(config))
    return {"recorded": starts.recorded, **starts.driven}


def joined(first: Measured, second: Measured) -> Measured:
    """The units of both, one after the other; quantiles are left out."""
    counts = {
        name: np.concatenate((first.counts[name], second.counts[name])) for name in first.counts
    }
    return Measured(
        counts,
        {},
        first.lane_changes + second.lane_changes,
        first.vehicle_km + second.vehicle_km,
    )


def fold_card(options: argparse.Namespace) -> str:
    """Distances to recorded driving of all folds together, and lane changes."""
    folds = [driven_by(file) for file in options.weights]
    driven = {name: reduce(joined, (fold[name] for fold in folds)) for name in folds[0]}
    recorded = driven["recorded"]
    rivals = {name: driven[name] for name in ("human", *RIVALS)}
    lines = []
    for quantity, row in quantity_rows("human", rivals, recorded.counts, floors={}).items():
        line = [quantity, with_interval(row, "distance"), number(row["ceiling"])]
        for rival in row["against"].values():
            line += [with_interval(rival, "distance"), with_sign(rival, "difference", 3)]
        lines.append(line)
    rates = [
        f"{name} {with_interval(measured.summary(), 'per_vehicle_km', 2)}"
        for name, measured in {"recorded": recorded, **rivals}.items()
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
