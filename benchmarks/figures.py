"""The figures of the docs that need no long run: the architecture, and recorded against generated courses.

    python benchmarks/figures.py --folder docs/figures
    python benchmarks/figures.py --folder docs/figures --scene us101-e --lane 1

Writes generator_architecture.png (the paper's Figure 1, with the shapes of the generator that ships) and
generator_courses.png (its Figure 2: a scene that the generator was not fitted to; needs the recordings).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from ganlane.benchmarks.script import parser_of, run_script
from ganlane.data import default_scenes, read_scenes, scene_lane_widths
from ganlane.evaluation.realism import StartOptions, drive_recordings, recorded_frame, recordings_of
from ganlane.generator import Discriminator, load_generator, shipped_generator
from ganlane.sim.random import Stream
from ganlane.sim.road import Road
from ganlane.traffic import TrafficModule
from ganlane.traffic.presets import gan_calibrated_traffic
from ganlane.view.architecture import discriminator_blocks, draw_architecture, generator_blocks
from ganlane.view.realism import write_figure
from ganlane.view.space_time import draw_space_time


def architecture() -> Image.Image:
    """Both networks of the paper's preset."""
    generator, metadata = load_generator(shipped_generator("paper"), "paper")
    sizes = generator.sizes
    discriminator = Discriminator(sizes.embedding, sizes.hidden)
    return draw_architecture(
        {
            f"generator of the preset {metadata['preset']}, for 9 vehicles": generator_blocks(generator),
            "discriminator": discriminator_blocks(discriminator, sizes.observed + sizes.predicted),
        }
    )


def courses(scene: str, lane: int) -> Image.Image:
    """The vehicles of one lane as recorded, and as the calibrated traffic drives them from the same start."""

    def make(road: Road) -> TrafficModule:
        return gan_calibrated_traffic(road, Stream.REPORT)

    frame = read_scenes(default_scenes())
    (recording,) = recordings_of(frame, scene_lane_widths(frame), [scene])
    driven = drive_recordings(make, [recording], StartOptions(desired_above_mps=11.0))
    return draw_space_time(scene, lane, {"recorded": recorded_frame([recording]), "gan_calibrated": driven})


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """What the command line says."""
    parser = parser_of(__doc__)
    parser.add_argument("--folder", type=Path, default=Path("docs/figures"))
    parser.add_argument("--scene", default="us101-b", help="a scene that the generator was not fitted to")
    parser.add_argument("--lane", type=int, default=2, help="0 is the rightmost")
    return parser.parse_args(arguments)


def draw(told: argparse.Namespace) -> str:
    """Draw and write; where the figures are."""
    written = [told.folder / f"generator_{name}.png" for name in ("architecture", "courses")]
    write_figure(architecture(), written[0])
    write_figure(courses(told.scene, told.lane), written[1])
    return "\n".join(map(str, written))


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw; the exit status."""
    return run_script(draw, parse(arguments))


if __name__ == "__main__":
    sys.exit(main())
