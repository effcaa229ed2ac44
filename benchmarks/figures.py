"""The paper's Figures 1, 2 and 4, from what ships: networks, courses, learning curves.

    python -m benchmarks.figures

Figure 1 is printed: the parts of the paper's generator and discriminator as tables. Figure 2,
generator_courses.png, is a scene that the generator was not fitted to, and needs the recordings.
Figure 4, transfer.png, has the learning curves of trainings in two phases, the change of traffic
marked, from ``docs/learning_curves/seed_*`` and ``docs/reproduce/results.json``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import polars as pl
import torch
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from torch import Tensor, nn

from benchmarks import printed
from benchmarks.script import ROOT, make_parser, markdown, run_script
from ganlane.data import FRAME_S, default_scenes, read_scenes
from ganlane.data.dense import recordings_of
from ganlane.evaluation.table import Table
from ganlane.generator import Discriminator, Generator, load_generator, shipped_generator
from ganlane.generator.networks import MotionLSTM
from ganlane.realism.driving import StartOptions, drive_recordings
from ganlane.sim.random import Stream
from ganlane.traffic.presets import gan_calibrated_traffic
from ganlane.view.curves import plot_middle, read_metrics
from ganlane.view.figures import COLOURS, FAINT, INK, STYLE, add_legend, save_figure

DOCS = ROOT / "docs"
FOLDER = DOCS / "figures"
#: On which the networks are run, to see their shapes.
VEHICLES = 9
#: A scene that the generator was not fitted to, and the lane that is drawn; 0 is the rightmost.
SCENE, LANE = "us101-b", 2


class Block(NamedTuple):
    """A part of a network.

    Its name, what it does, the shape of its output, and its number of weights.
    """

    title: str
    does: str
    shape: tuple[int, ...]
    parameters: int


def _block(title: str, does: str, output: Tensor, *modules: nn.Module) -> Block:
    """Of a part with these ``modules`` and this ``output``, whose first axis is the batch."""
    parameters = sum(p.numel() for module in modules for p in module.parameters())
    return Block(title, does, tuple(output.shape[1:]), parameters)


def _encoder_blocks(encoder: MotionLSTM, projections: tuple[Tensor, ...]) -> list[Block]:
    """Embedding and LSTM on the ``projections`` of displacements."""
    projected = torch.stack(projections, dim=2)
    embed = encoder.embed
    sizes = f"{embed.in_features} to {embed.out_features}, ReLU, to the LSTM's gates"
    motions = f"{projected.shape[2]} motions, last state"
    recurrent = nn.ParameterList([encoder.recurrent])
    return [
        _block("embedding", sizes, projected, embed, encoder.input),
        _block("LSTM encoder", motions, encoder.encode(projections), recurrent),
    ]


@torch.no_grad()
def generator_blocks(generator: Generator) -> list[Block]:
    """The parts of the paper's generator in order, with the shapes of their outputs (batch left
    out).
    """
    sizes = generator.sizes
    observed = torch.zeros(1, VEHICLES, sizes.observed, 2)
    seen = generator.observe(observed, observed[:, :, 0], torch.ones(1, VEHICLES, dtype=torch.bool))
    hidden = generator.encoder.encode(seen.projections)
    pooled = generator.pooling(hidden, seen.position, seen.displacement, seen.valid)
    noise = torch.zeros(1, VEHICLES, sizes.noise)
    outputs = generator(seen, noise)
    decoder, pooling = generator.decoder, generator.pooling
    return [
        _block("observed displacements", "of every vehicle, m per 0.1 s", observed),
        *_encoder_blocks(generator.encoder, seen.projections),
        _block(
            "pooling over pairs",
            f"{pooling.neighbours} nearest, to {pooling.per_pair.out_features}, ReLU, "
            f"to {pooling.second.out_features}, maximum",
            pooled,
            pooling,
        ),
        _block(
            "context",
            "of state and pooled neighbours",
            generator.summarise(seen),
            generator.context,
        ),
        _block("noise", "a latent vector z a driver, joined to the context", noise),
        _block(
            "LSTM decoder",
            f"{sizes.predicted} steps from context and noise ({decoder.hidden} numbers)",
            torch.zeros(*outputs.shape[:-1], decoder.hidden),
            decoder,
        ),
        _block(
            "predicted displacements",
            "a residual on the last displacement",
            outputs,
            generator.head,
        ),
    ]


@torch.no_grad()
def discriminator_blocks(discriminator: Discriminator, steps: int) -> list[Block]:
    """The discriminator's parts, run on ``steps`` displacements."""
    shown = torch.zeros(1, VEHICLES, steps, 2)
    encoder = discriminator.encoder
    return [
        _block("displacements", "observed, then recorded or predicted", shown),
        *_encoder_blocks(encoder, encoder.project_course(shown)),
        _block("logit", "recorded or predicted", discriminator(shown), discriminator.head),
    ]


def table_of(title: str, blocks: Sequence[Block]) -> Table:
    """A line for each part."""
    lines = [
        [block.title, block.does, str(list(block.shape)), f"{block.parameters:,}"]
        for block in blocks
    ]
    return Table(title, ["part", "what it does", "its output", "weights"], lines, names=2)


def architecture() -> str:
    """Both networks of the paper's preset, as tables."""
    generator, metadata = load_generator(shipped_generator("paper"), "paper")
    sizes = generator.sizes
    discriminator = Discriminator(sizes.embedding, sizes.hidden)
    networks = {
        f"Generator of the preset {metadata['preset']}": generator_blocks(generator),
        "Discriminator": discriminator_blocks(discriminator, sizes.observed + sizes.predicted),
    }
    return "\n\n".join(markdown(table_of(*network)) for network in networks.items())


@rc_context(STYLE)
def courses() -> Figure:
    """Positions over time of the vehicles in :data:`LANE`: as recorded in black, and, dashed over
    it, as the calibrated traffic drives them from the same start.
    """
    frame = read_scenes(default_scenes()).filter(pl.col("scene") == SCENE)
    (recording,) = recordings_of(frame)
    make = partial(gan_calibrated_traffic, stream=Stream.REPORT)
    (driven,) = drive_recordings(make, [recording], StartOptions(desired_above_mps=11.0))
    figure = Figure(figsize=(7.5, 4.3))
    axes = figure.subplots()
    axes.set(title=f"{SCENE}, lane {LANE}", xlabel="time, s", ylabel="position, m")
    colours = {"recorded": INK, "gan_calibrated": COLOURS[0]}
    for course, style, colour in zip((recording, driven), ("-", "--"), colours.values()):
        for track in course.frame().partition_by("vehicle", maintain_order=True):
            if track["lane"][0] == LANE:
                axes.plot(track["frame"] * FRAME_S, track["x"], style, color=colour)
    add_legend(figure, colours)
    return figure


def read_curves() -> pl.DataFrame:
    """The evaluations of the committed training runs, which have two phases.

    Returns:
        Their columns, ``decisions`` over both phases; ``run`` and ``phase`` (``first`` or
        ``second``).
    """
    parts = []
    for folder in sorted((DOCS / "learning_curves").glob("seed_*")):
        before = 0
        for phase, path in (("first", folder / "pretrain"), ("second", folder)):
            curve = read_metrics(path / "evaluation.csv")
            counted = curve.with_columns(pl.col("decisions") + before)
            parts.append(counted.with_columns(run=pl.lit(folder.name), phase=pl.lit(phase)))
            # The second phase goes on counting where the first one ended.
            before = curve["decisions"][-1]
    return pl.concat(parts, how="vertical_relaxed")


@rc_context(STYLE)
def transfer() -> Figure:
    """Figure 4: every run of :func:`read_curves`, their median, and the range between them.

    The crosses are rewards on the new traffic before any training there.
    """
    row = printed.at(printed.load(), "agent_idm+none", "gan")
    before = [training["mean_reward"] for training in row["each"]]
    curves = read_curves()
    figure = Figure(figsize=(7.0, 3.4))
    axes = figure.subplots()
    axes.set(title="evaluations during training", xlabel="decisions", ylabel="mean reward")
    axes.xaxis.set_major_formatter(EngFormatter())
    for (_, phase), colour in zip(curves.group_by("phase", maintain_order=True), COLOURS):
        runs = phase.partition_by("run", maintain_order=True)
        points = [(run["decisions"].to_numpy(), run["mean_reward"].to_numpy()) for run in runs]
        plot_middle(axes, points, middle=np.median, color=colour)
        for run in points:
            axes.plot(*run, color=colour, lw=0.5, alpha=0.6)
    # Where the second phase begins.
    switch = curves.filter(phase="first")["decisions"].to_numpy().max()
    axes.axvline(switch, color=FAINT, ls=":")
    axes.plot([switch] * len(before), before, "x", color=COLOURS[1])
    names = ("on idm_mobil", "on gan (x: before any training there)")
    add_legend(figure, dict(zip(names, COLOURS)))
    return figure


def draw(options: argparse.Namespace) -> str:
    """The tables, and where the figures are."""
    figures = {"generator_courses": courses, "transfer": transfer}
    places = [save_figure(make(), FOLDER / f"{name}.png") for name, make in figures.items()]
    return "\n\n".join([architecture(), *map(str, places)])


if __name__ == "__main__":
    sys.exit(run_script(draw, make_parser(__doc__).parse_args()))
