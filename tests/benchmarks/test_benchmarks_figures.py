"""The figures of the docs.

Shapes and weights are those of the loaded networks, courses those of the vehicles.
"""

from __future__ import annotations

import polars as pl
import pytest
from matplotlib.colors import to_hex

from benchmarks.figures import (
    draw_space_time,
    generator_blocks,
    lane_courses,
)
from ganlane.generator import load_generator, shipped_generator
from ganlane.view.figures import COLOURS, INK


@pytest.mark.parametrize("preset", ["paper", "calibrated"])
def test_the_architecture_shows_every_weight_and_the_shapes_of_the_loaded_generator(preset):
    generator, _ = load_generator(shipped_generator(preset), preset)
    sizes, blocks = (
        generator.sizes,
        {block.title: block for block in generator_blocks(generator, vehicles=5)},
    )
    assert sum(block.parameters for block in blocks.values()) == sum(
        p.numel() for p in generator.parameters()
    )
    assert blocks["observed displacements"].shape == (5, sizes.observed, 2)
    assert blocks["embedding"].shape == (5, sizes.observed - 1, 4 * sizes.hidden)
    assert blocks["context"].shape == (5, sizes.hidden - sizes.noise)
    assert blocks["predicted displacements"].shape == (5, sizes.predicted, 2)


def course(lanes):
    rows = [
        (vehicle, frame, 10.0 * vehicle + frame, lane)
        for vehicle, lane in enumerate(lanes)
        for frame in range(5)
    ]
    return pl.DataFrame(rows, schema=["vehicle", "frame", "x", "lane"], orient="row")


def test_a_lane_s_courses_are_its_vehicles_in_seconds_and_metres_each_in_its_colour():
    (time_s, _), (_, x_m) = lane_courses(course([1, 0, 1]), 1)
    assert time_s.tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert x_m.tolist() == [20.0, 21.0, 22.0, 23.0, 24.0]
    (axes,) = draw_space_time("a", 0, {"recorded": course([0, 0]), "driven": course([0])}).axes
    assert [to_hex(line.get_color()) for line in axes.lines] == [INK, INK, COLOURS[0]]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time, s", "position, m")
