"""Fits of ``human``, judged on what they never saw.

    python -m benchmarks.human_fits card RUN/generator_human.safetensors ...
    python -m benchmarks.human_fits sites RUN/generator_human.safetensors
    python -m benchmarks.human_fits responses

``card``: how close they come to recorded driving. Each file drives the scenes that were held out of
its fit (``ganlane train_generator generator=human 'data.held_out=[us101-a]'``), beside
`gan_calibrated` and `idm_mobil` from the same starts; desired speeds are fitted on the other
scenes. The table is of all these scenes together, the intervals are over scenes.

``sites``: forecasts of cars that follow each other on I-80 and I-24, by a fit to another site (with
a GANLANE_DATA that holds ``ngsim/us101_scenes.csv`` alone). Mean errors over 0.8 s and root mean
square errors at 5 s, over those of constant velocity, of the driven cars in the first 400 segments
of each file; beside it the shipped ``gan_calibrated``, and IDM with each driver's own headway.

``responses``: how strongly recorded followers respond to a speed difference, by their gap: the
slope of their mean acceleration over the next two seconds, 1/s.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from benchmarks.script import make_parser, markdown, run_script
from ganlane.commands.realism import drive_from_starts, factories_on_card, scenes_path
from ganlane.config.run import call_settings
from ganlane.data import default_scenes, read_scenes
from ganlane.data.dense import recordings_of
from ganlane.data.one_lane import one_lane_files, read_one_lane
from ganlane.evaluation.table import Table, with_interval
from ganlane.generator import load_generator, shipped_generator
from ganlane.generator.checkpoint import load_human
from ganlane.generator.fit import LONG_STEPS, errors_beside_references
from ganlane.generator.forecasts import (
    BASELINE,
    calibrated_driver,
    displacement_errors,
    driven_windows,
    long_errors,
)
from ganlane.generator.human import perceive
from ganlane.generator.human_forecasts import human_driver
from ganlane.generator.human_samples import HISTORY, batches, cuts, recorded, smooth_scene
from ganlane.generator.windows import OBSERVED_POSITIONS, PREDICTED_STEPS, cut_windows
from ganlane.keys import PHYSICS_STEP_S
from ganlane.realism.card import card_rows
from ganlane.realism.measures import RESAMPLES, Measured
from ganlane.realism.sheets import quantities_table
from ganlane.realism.starts import Starts
from ganlane.settings.generator import CalibratedConfig, HumanConfig
from ganlane.settings.recordings import RealismConfig
from ganlane.weights import load_weights

SEGMENTS = 400
#: Bounds of the gaps in ``responses``, m.
GAPS_M = (2, 8, 15, 25, 40, 70, 120)
#: The two seconds after a decision, in frames.
AFTER = 20
#: Steps of the forecasts, and frames between the starts of two windows.
HORIZONS = ((PREDICTED_STEPS, 10), (LONG_STEPS, 25))


def sites(weights: Path) -> str:
    """A line for each file and horizon."""
    policy, _ = load_human(weights)
    calibrated, _ = load_generator(shipped_generator("calibrated"), "calibrated")
    lines = []
    for name, path in one_lane_files(default_scenes()).items():
        scenes = read_one_lane(name, path)[:SEGMENTS]
        driven = {scene.name: scene.driven for scene in scenes}
        for steps, stride in HORIZONS:
            windows = cut_windows(scenes, stride, OBSERVED_POSITIONS + steps)
            drivers = {
                "human": human_driver(policy, 0),
                "gan_calibrated": calibrated_driver(calibrated, CalibratedConfig(), 0),
            }
            forecasts = {
                kind: driven_windows(driver, scenes, steps, stride)[0]
                for kind, driver in drivers.items()
            }
            all_errors = errors_beside_references(forecasts, windows, scenes, stride)
            rows = [driven[scene][car] for scene, car in zip(windows.scene, windows.vehicle)]
            errors = {kind: values[rows] for kind, values in all_errors.items()}
            if steps == PREDICTED_STEPS:
                scores = displacement_errors(errors)["ade_m"]
            else:
                rmse = long_errors(errors)["rmse_m"]
                scores = {kind: values["5 s"] for kind, values in rmse.items()}
            baseline = scores.pop(BASELINE)
            ratios = [f"{score / baseline:.2f}" for score in scores.values()]
            lines.append([name, f"{steps / 10:g}", str(sum(rows)), f"{baseline:.2f}", *ratios])
    headings = ["file", "s", "windows", f"{BASELINE}, m", *scores]
    return markdown(Table("", headings, lines))


def responses() -> str:
    """A line for each file."""
    files = {"US-101": recordings_of(read_scenes(default_scenes()))}
    for name, path in one_lane_files(default_scenes()).items():
        files[name] = read_one_lane(name, path)[:SEGMENTS]
    lines = []
    for name, recordings in files.items():
        scenes = [smooth_scene(recording, HumanConfig()) for recording in recordings]
        gaps, closing, accelerations = [], [], []
        for segments in batches(cuts(scenes, decisions=4, stride=AFTER)):
            vehicles, _ = recorded(segments, 0, segments.length)
            view = perceive(vehicles, segments.road)
            later = segments.speed[:, HISTORY + AFTER]
            who = vehicles.valid & segments.driven & segments.present[:, HISTORY + AFTER]
            gaps.append(view.gap[who])
            closing.append(view.closing[who])
            accelerations.append((later - view.speed)[who] / (AFTER * PHYSICS_STEP_S))
        gap, seen, done = (torch.cat(parts).numpy() for parts in (gaps, closing, accelerations))
        slopes = []
        for low, high in pairwise(GAPS_M):
            among = (gap >= low) & (gap < high) & (np.abs(seen) < 6.0)
            slope = np.polyfit(seen[among], done[among], 1)[0] if among.sum() > 100 else np.nan
            slopes.append(f"{slope:.2f}")
        lines.append([name, *slopes])
    headings = [f"{low} to {high} m" for low, high in pairwise(GAPS_M)]
    return markdown(Table("", ["file", *headings], lines))


def driven_by(file: Path) -> Starts:
    """The fit and its rivals in the scenes that it never saw."""
    held_out = load_weights(file, "generator")[1]["data"]["held_out"]
    keys = {
        "traffic": {"name": "human", "path": str(file)},
        "against": ["gan_calibrated", "idm_mobil"],
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


def card(weights: Sequence[Path]) -> str:
    """Distances to recorded driving of all folds together, and lane changes."""
    folds = [driven_by(file) for file in weights]
    driven = {name: joined([fold.driven[name] for fold in folds]) for name in folds[0].driven}
    recorded = joined([fold.recorded for fold in folds])
    rows = card_rows(replace(folds[0], driven=driven, recorded=recorded), RESAMPLES)
    lines = [quantities_table(rows, "human"), "changes per vehicle-km"]
    for name, measured in {"recorded": recorded, **driven}.items():
        lines.append(f"{name} {with_interval(measured.summary(), 'per_vehicle_km', 2)}")
    return "\n".join(lines)


def judged(options: argparse.Namespace) -> str:
    """One of the three."""
    if options.action == "responses":
        return responses()
    if options.action == "card":
        return card(options.weights)
    return "\n\n".join(map(sites, options.weights))


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("action", choices=("card", "sites", "responses"))
    parser.add_argument("weights", nargs="*", type=Path)
    sys.exit(run_script(judged, parser.parse_args()))
