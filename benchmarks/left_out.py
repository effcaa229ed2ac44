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

import numpy as np

from benchmarks.script import make_parser, markdown, run_script
from ganlane.data import default_scenes
from ganlane.data.one_lane import one_lane_files, read_one_lane
from ganlane.evaluation.table import Table
from ganlane.generator import load_generator, shipped_generator
from ganlane.generator.checkpoint import load_human
from ganlane.generator.forecasts import (
    BASELINE,
    calibrated_forecasts,
    errors_of,
    idm_forecast,
    repeated,
)
from ganlane.generator.human_forecasts import human_forecasts
from ganlane.generator.windows import OBSERVED_POSITIONS, cut_windows
from ganlane.settings.generator import CalibratedConfig

SEGMENTS = 400
#: Steps of the forecasts, and frames between the starts of two windows.
HORIZONS = ((8, 10), (50, 25))


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
            forecasts = {
                BASELINE: repeated(windows.past[:, -1], steps),
                "human": human_forecasts(policy, scenes, steps, stride, 0)["mean"],
                "gan_calibrated": calibrated_forecasts(
                    calibrated, scenes, steps, stride, CalibratedConfig(), 0
                )["mean"],
                "idm": idm_forecast(scenes, steps, stride),
            }
            rows = [driven[scene][car] for scene, car in zip(windows.scene, windows.vehicle)]
            scores = []
            for errors in errors_of(forecasts, windows.future).values():
                last = np.sqrt((errors[rows, -1] ** 2).mean())
                scores.append(errors[rows].mean() if steps == HORIZONS[0][0] else last)
            ratios = [f"{score / scores[0]:.2f}" for score in scores[1:]]
            lines.append([name, f"{steps / 10:g}", str(sum(rows)), f"{scores[0]:.2f}", *ratios])
    headings = ["file", "s", "windows", f"{BASELINE}, m", *list(forecasts)[1:]]
    return markdown(Table("", headings, lines))


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("weights", type=Path)
    sys.exit(run_script(judged, parser.parse_args()))
