"""The figures of the docs that need no long run: the architecture, and recorded against generated
courses.

    python -m benchmarks.figures --folder docs/figures

Writes generator_architecture.png (the paper's Figure 1, with the shapes of the generator that
ships) and generator_courses.png (its Figure 2: a scene that the generator was not fitted to; needs
the recordings).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl
import torch
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from torch import Tensor, nn

from benchmarks.script import make_parser, run_script
from ganlane.data import FRAME_S, default_scenes, read_scenes
from ganlane.data.dense import recordings_of
from ganlane.generator import Discriminator, Generator, load_generator, shipped_generator
from ganlane.generator.networks import MotionLSTM
from ganlane.realism.driving import StartOptions, drive_recordings
from ganlane.sim.random import Stream
from ganlane.sim.state import Road
from ganlane.traffic import TrafficModule
from ganlane.traffic.presets import gan_calibrated_traffic
from ganlane.view.figures import COLOURS, FAINT, INK, STYLE, add_legend, palette, save_figure

#: Boxes in a row of the drawing of a network, and inches from one box to the next, across and down.
_ACROSS, _STEP_X, _STEP_Y = 4, 2.0, 1.15
#: A scene that the generator was not fitted to, and the lane that is drawn; 0 is the rightmost.
SCENE, LANE = "us101-b", 2


@dataclass(frozen=True)
class Block:
    """A part of a network.

    Its name, what it does (two lines), the shape of its output, and its number of weights.
    """

    title: str
    does: tuple[str, str]
    shape: tuple[int, ...]
    parameters: int = 0


def _block(title: str, first: str, second: str, output: Tensor, *modules: nn.Module) -> Block:
    """Of a part with these ``modules`` and this ``output``, whose first axis is the batch."""
    parameters = sum(p.numel() for module in modules for p in module.parameters())
    return Block(title, (first, second), tuple(output.shape[1:]), parameters)


def _encoder_blocks(encoder: MotionLSTM, projections: tuple[Tensor, ...]) -> list[Block]:
    """Embedding and LSTM on the ``projections`` of displacements."""
    projected = torch.stack(projections, dim=2)
    embed = encoder.embed
    sizes = f"{embed.in_features} to {embed.out_features}, ReLU,"
    motions = f"{projected.shape[2]} motions,"
    recurrent = nn.ParameterList([encoder.recurrent])
    return [
        _block("embedding", sizes, "to the LSTM's gates", projected, embed, encoder.input),
        _block("LSTM encoder", motions, "last state", encoder.encode(projections), recurrent),
    ]


@torch.no_grad()
def generator_blocks(generator: Generator, vehicles: int = 9) -> list[Block]:
    """The generator's parts in order, run on ``vehicles`` vehicles to see the shapes (batch left
    out).
    """
    sizes = generator.sizes
    observed = torch.zeros(1, vehicles, sizes.observed, 2)
    seen = generator.observe(observed, observed[:, :, 0], torch.ones(1, vehicles, dtype=torch.bool))
    seen = seen._replace(extra=torch.zeros(1, vehicles, sizes.extra_inputs))
    hidden = generator.encoder.encode(seen.projections)
    pooled = generator.pooling(hidden, seen.position, seen.displacement, seen.valid)
    noise = torch.zeros(1, vehicles, sizes.noise)
    outputs = generator(seen, noise)
    decoder, pooling = generator.decoder, generator.pooling
    extra = f", {sizes.extra_inputs} further inputs" if sizes.extra_inputs else ""
    return [
        _block("observed displacements", "of every vehicle,", "m per 0.1 s", observed),
        *_encoder_blocks(generator.encoder, seen.projections),
        _block(
            "pooling over pairs",
            f"{pooling.neighbours} nearest, to {pooling.per_pair.out_features}, ReLU,",
            f"to {pooling.second.out_features}, maximum",
            pooled,
            pooling,
        ),
        _block(
            "context",
            "of state and pooled",
            f"neighbours{extra}",
            generator.summarise(seen),
            generator.context,
        ),
        _block("noise", "a latent vector z a driver,", "joined to the context", noise),
        _block(
            "LSTM decoder",
            f"{sizes.predicted} steps from context",
            f"and noise ({decoder.hidden} numbers)",
            torch.zeros(*outputs.shape[:-1], decoder.hidden),
            decoder,
        ),
        _block(
            "predicted displacements",
            "a residual on the",
            "last displacement",
            outputs,
            generator.head,
        ),
    ]


@torch.no_grad()
def discriminator_blocks(
    discriminator: Discriminator, steps: int, vehicles: int = 9
) -> list[Block]:
    """The discriminator's parts, run on ``steps`` displacements of ``vehicles`` vehicles."""
    shown = torch.zeros(1, vehicles, steps, 2)
    encoder = discriminator.encoder
    return [
        _block("displacements", "observed, then recorded", "or predicted", shown),
        *_encoder_blocks(encoder, encoder.project_course(shown)),
        _block("logit", "recorded or", "predicted", discriminator(shown), discriminator.head),
    ]


@rc_context(STYLE)
def draw_architecture(networks: Mapping[str, Sequence[Block]]) -> Figure:
    """Rows of boxes for each network, four in a row, with an arrow from each to the next."""
    rows = [
        (name if first == 0 else "", blocks[first : first + _ACROSS], colour)
        for (name, blocks), colour in zip(networks.items(), COLOURS)
        for first in range(0, len(blocks), _ACROSS)
    ]
    width, height = _ACROSS * _STEP_X, len(rows) * _STEP_Y
    figure = Figure(figsize=(width, height), layout="none")
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.set_axis_off()
    for row, (name, blocks, colour) in enumerate(rows):
        axes.text(0.12, row * _STEP_Y + 0.14, name, color=colour, va="center", size=10)
        for place, block in enumerate(blocks):
            left, top = place * _STEP_X + 0.12, row * _STEP_Y + 0.28
            _draw_block(axes, left, top, block, colour)
            if place + 1 < len(blocks):
                arrow = {"arrowstyle": "-|>", "color": FAINT, "shrinkA": 0, "shrinkB": 0}
                ends = (left + 1.98, top + 0.4), (left + 1.68, top + 0.4)
                axes.annotate("", *ends, arrowprops=arrow)
    return figure


def _draw_block(axes: Axes, left: float, top: float, block: Block, colour: str) -> None:
    """A box of 1.65 by 0.8 inches with its four lines."""
    style = "round,pad=0,rounding_size=0.07"
    axes.add_patch(
        FancyBboxPatch((left, top), 1.65, 0.8, boxstyle=style, fc="white", ec=colour, lw=1.5)
    )

    def write(right: float, down: float, text: str, size: float, **style: Any) -> None:
        axes.text(left + right, top + down, text, va="center", size=size, **style)

    write(0.08, 0.14, block.title, 8.5)
    for line, text in enumerate(block.does):
        write(0.08, 0.3 + 0.15 * line, text, 7, color=FAINT)
    write(0.08, 0.67, str(list(block.shape)), 8.5, color=colour)
    if block.parameters:
        write(1.57, 0.67, f"{block.parameters} weights", 7, color=FAINT, ha="right")


@rc_context(STYLE)
def draw_space_time(courses: Mapping[str, pl.DataFrame]) -> Figure:
    """Positions over time of the vehicles in :data:`LANE`, the first of ``courses`` in black and
    the others dashed over it.

    Args:
        courses: name to trajectories (:func:`ganlane.data.dense.Recording.frame`) of
            :data:`SCENE`.
    """
    first, *others = courses
    colours = {first: INK, **palette(others)}
    figure = Figure(figsize=(7.5, 4.3))
    axes = figure.subplots()
    axes.set(title=f"{SCENE}, lane {LANE}", xlabel="time, s", ylabel="position, m")
    for name, frame in courses.items():
        style = "-" if name == first else "--"
        for track in frame.partition_by("vehicle", maintain_order=True):
            if track["lane"][0] == LANE:
                axes.plot(track["frame"] * FRAME_S, track["x"], style, color=colours[name])
    add_legend(figure, colours)
    return figure


def architecture() -> Figure:
    """Both networks of the paper's preset."""
    generator, metadata = load_generator(shipped_generator("paper"), "paper")
    sizes = generator.sizes
    discriminator = Discriminator(sizes.embedding, sizes.hidden)
    title = f"generator of the preset {metadata['preset']}, for 9 vehicles"
    blocks = discriminator_blocks(discriminator, sizes.observed + sizes.predicted)
    return draw_architecture({title: generator_blocks(generator), "discriminator": blocks})


def courses() -> Figure:
    """The vehicles of one lane as recorded, and as the calibrated traffic drives them from the same
    start.
    """

    def make(road: Road) -> TrafficModule:
        return gan_calibrated_traffic(road, Stream.REPORT)

    frame = read_scenes(default_scenes()).filter(pl.col("scene") == SCENE)
    (recording,) = recordings_of(frame)
    (driven,) = drive_recordings(make, [recording], StartOptions(desired_above_mps=11.0))
    return draw_space_time({"recorded": recording.frame(), "gan_calibrated": driven.frame()})


def draw(options: argparse.Namespace) -> str:
    """Draw and write; where the figures are."""
    figures = {"architecture": architecture, "courses": courses}
    return "\n".join(
        str(save_figure(make(), options.folder / f"generator_{name}.png"))
        for name, make in figures.items()
    )


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("--folder", type=Path, default=Path("docs/figures"))
    sys.exit(run_script(draw, parser.parse_args()))
