"""Forecasts of cars that follow each other on I-80 and I-24 by a policy of ``human``.

    GANLANE_DATA=FOLDER ganlane train_generator generator=human
    python -m benchmarks.left_out RUN/generator_human.safetensors

With a FOLDER that holds ``ngsim/us101_scenes.csv`` alone the first command fits to that site, and
the second, with all recordings at hand, judges it on the others: mean errors over 0.8 s, and
root mean square errors at 5 s, over those of constant velocity, of the driven cars in the first
400 segments of each file; beside it the shipped ``gan_calibrated``, and IDM with each driver's own
headway.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.script import make_parser, markdown, run_script
from ganlane.data import default_scenes
from ganlane.data.one_lane import one_lane_files, read_one_lane
from ganlane.evaluation.table import Table
from ganlane.generator import load_generator, shipped_generator
from ganlane.generator.checkpoint import load_human
from ganlane.generator.fit import LONG_STEPS
from ganlane.generator.forecasts import (
    BASELINE,
    calibrated_driver,
    displacement_errors,
    driven_windows,
    errors_of,
    idm_driver,
    long_errors,
    repeated,
)
from ganlane.generator.human_forecasts import human_driver
from ganlane.generator.windows import OBSERVED_POSITIONS, PREDICTED_STEPS, cut_windows
from ganlane.settings.generator import CalibratedConfig

SEGMENTS = 400
#: Steps of the forecasts, and frames between the starts of two windows.
HORIZONS = ((PREDICTED_STEPS, 10), (LONG_STEPS, 25))


def judged(options: argparse.Namespace) -> str:
    """A line for each file and horizon."""
    policy, _ = load_human(options.weights)
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
                "idm": idm_driver,
            }
            forecasts = {BASELINE: repeated(windows.past[:, -1], steps)}
            for kind, driver in drivers.items():
                (forecasts[kind],) = driven_windows(driver, scenes, steps, stride)
            rows = [driven[scene][car] for scene, car in zip(windows.scene, windows.vehicle)]
            errors = {
                kind: values[rows] for kind, values in errors_of(forecasts, windows.future).items()
            }
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


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("weights", type=Path)
    sys.exit(run_script(judged, parser.parse_args()))
