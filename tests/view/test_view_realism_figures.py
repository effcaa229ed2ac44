"""Figures of the realism card and of the generator: what they show is what was measured or loaded."""

import numpy as np
import polars as pl
import pytest
from PIL import Image

from ganlane.generator import Discriminator, load_generator, shipped_generator
from ganlane.view.architecture import discriminator_blocks, draw_architecture, generator_blocks
from ganlane.view.plot import INK, LINES
from ganlane.view.realism_distances import draw_distances
from ganlane.view.space_time import draw_space_time, lane_lines


def colours(picture: Image.Image) -> set:
    return {tuple(colour) for colour in np.unique(np.asarray(picture).reshape(-1, 3), axis=0)}


@pytest.mark.parametrize("preset", ["paper", "calibrated"])
def test_the_architecture_shows_every_weight_and_the_shapes_of_the_loaded_generator(preset):
    generator, _ = load_generator(shipped_generator(preset), preset)
    sizes, blocks = generator.sizes, {block.title: block for block in generator_blocks(generator, vehicles=5)}
    assert sum(block.parameters for block in blocks.values()) == sum(p.numel() for p in generator.parameters())
    assert blocks["observed displacements"].shape == (5, sizes.observed, 2)
    assert blocks["embedding"].shape == (5, sizes.observed - 1, 4 * sizes.hidden)
    assert blocks["context"].shape == (5, sizes.hidden - sizes.noise)
    assert blocks["predicted displacements"].shape == (5, sizes.predicted, 2)


def test_the_discriminator_gives_one_logit_per_vehicle():
    discriminator = Discriminator()
    blocks = discriminator_blocks(discriminator, 16, vehicles=5)
    assert blocks[-1].shape == (5,)
    assert sum(block.parameters for block in blocks) == sum(p.numel() for p in discriminator.parameters())
    picture = draw_architecture({"discriminator": blocks})
    assert LINES[0] in colours(picture)


def course(lanes):
    rows = [
        (vehicle, frame, 10.0 * vehicle + frame, lane) for vehicle, lane in enumerate(lanes) for frame in range(5)
    ]
    return pl.DataFrame(rows, schema=["vehicle", "frame", "x", "lane"], orient="row")


def test_a_lane_s_lines_are_its_vehicles_in_seconds_and_metres():
    one, other = lane_lines(course([1, 0, 1]), 1, INK)
    assert one.x.tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert other.y.tolist() == [20.0, 21.0, 22.0, 23.0, 24.0]


def test_courses_of_all_are_in_one_plot_each_in_its_colour():
    picture = draw_space_time("a", 0, {"recorded": course([0, 0]), "driven": course([0])})
    assert {INK, LINES[0]} <= colours(picture)


def row(distance, **against):
    scale = {"ceiling": 0.1, "floor": 0.9}
    return {"distance": distance, "distance_ci": [distance - 0.1, distance + 0.1], **scale, "against": against}


def test_every_traffic_has_its_dot_at_its_distance():
    rival = {"distance": 0.75, "distance_ci": None}
    picture = np.asarray(draw_distances({"speed": row(0.25, rule=rival)}, "mine"))
    legend = 44
    for colour, distance in ((LINES[0], 0.25), (LINES[1], 0.75)):
        there = np.argwhere((picture[legend:] == colour).all(-1))
        assert there[:, 1].mean() == pytest.approx(190 + 620 * distance, abs=2)


def test_a_quantity_without_a_distance_has_no_dot():
    nothing = {**row(0.5), "distance": None, "distance_ci": None}
    picture = np.asarray(draw_distances({"lane_change_duration": nothing}, "mine"))
    assert not (picture[44:] == LINES[0]).all(-1).any()
