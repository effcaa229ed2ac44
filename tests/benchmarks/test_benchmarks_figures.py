"""The figures of the docs.

Shapes and weights are those of the loaded networks, courses those of the vehicles.
"""

from benchmarks.figures import VEHICLES, generator_blocks, transfer
from ganlane.generator import load_generator, shipped_generator
from ganlane.view.figures import save_figure


def test_the_architecture_shows_every_weight_and_the_shapes_of_the_loaded_generator():
    generator, _ = load_generator(shipped_generator("paper"), "paper")
    sizes = generator.sizes
    blocks = {block.title: block for block in generator_blocks(generator)}
    assert sum(block.parameters for block in blocks.values()) == sum(
        p.numel() for p in generator.parameters()
    )
    assert blocks["observed displacements"].shape == (VEHICLES, sizes.observed, 2)
    assert blocks["embedding"].shape == (VEHICLES, sizes.observed - 1, 4 * sizes.hidden)
    assert blocks["context"].shape == (VEHICLES, sizes.hidden - sizes.noise)
    assert blocks["predicted displacements"].shape == (VEHICLES, sizes.predicted, 2)


def test_the_transfer_is_drawn_from_the_committed_curves(tmp_path):
    assert save_figure(transfer(), tmp_path / "figure.png").stat().st_size > 10_000
