"""The generator's and the discriminator's parts with their tensors' shapes, as the loaded networks have them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from PIL import Image, ImageDraw
from torch import Tensor, nn

from ganlane.generator import Discriminator, Generator
from ganlane.view.plot import FAINT, INK, LINES, PAPER
from ganlane.view.style import Colour, put_text

#: Pixels of a box, the space between boxes, and the margin.
_WIDTH, _HEIGHT, _SPACE, _LINE, _MARGIN = 196, 104, 40, 150, 16
_TITLE = 26
#: Boxes in a line of the drawing.
_ACROSS = 4


@dataclass(frozen=True)
class Block:
    """A part: what it is called, what it does (two lines), the shape of what comes out, and its parameters."""

    title: str
    does: tuple[str, str]
    shape: tuple[int, ...]
    parameters: int = 0


def _count(*modules: nn.Module) -> int:
    return sum(each.numel() for module in modules for each in module.parameters())


@torch.no_grad()
def generator_blocks(generator: Generator, vehicles: int = 9) -> list[Block]:
    """The generator's parts in order, run on ``vehicles`` vehicles to see the shapes (batch left out)."""
    sizes = generator.sizes
    observed = torch.zeros(1, vehicles, sizes.observed, 2)
    seen = generator.observe(observed, observed[:, :, 0], torch.ones(1, vehicles, dtype=torch.bool))
    seen = seen._replace(extra=torch.zeros(1, vehicles, sizes.extra_inputs))
    hidden = generator.encoder.encode(seen.projections)
    pooled = generator.pooling(hidden, seen.position, seen.displacement, seen.valid)
    context, noise = generator.summarise(seen), torch.zeros(1, vehicles, sizes.noise)
    outputs = generator(seen, noise)
    encoder, decoder, pooling = generator.encoder, generator.decoder, generator.pooling
    projected = seen.projections
    assert isinstance(projected, Tensor)
    extra = f", {sizes.extra_inputs} further inputs" if sizes.extra_inputs else ""
    width = encoder.embed.out_features
    return [
        Block("observed displacements", ("of every vehicle,", "m per 0.1 s"), _shape(observed)),
        Block("embedding", (f"{encoder.embed.in_features} to {width}, ReLU,", "to the LSTM's gates"),
              _shape(projected), _count(encoder.embed, encoder.input)),
        Block("LSTM encoder", (f"{projected.shape[2]} motions,", "last state"), _shape(hidden),
              encoder.recurrent.numel()),
        Block("pooling over pairs", (f"{pooling.neighbours} nearest, to {pooling.per_pair.out_features}, ReLU,",
              f"to {pooling.second.out_features}, maximum"), _shape(pooled), _count(pooling)),
        Block("context", ("of state and pooled", f"neighbours{extra}"), _shape(context), _count(generator.context)),
        Block("noise", ("a latent vector z a driver,", "joined to the context"), _shape(noise)),
        Block("LSTM decoder", (f"{sizes.predicted} steps from context", f"and noise ({decoder.hidden} numbers)"),
              (vehicles, outputs.shape[-2], decoder.hidden), _count(decoder)),
        Block("predicted displacements", ("a residual on the", "last displacement"), _shape(outputs),
              _count(generator.head)),
    ]  # fmt: skip


@torch.no_grad()
def discriminator_blocks(discriminator: Discriminator, steps: int, vehicles: int = 9) -> list[Block]:
    """The discriminator's parts, run on ``steps`` displacements of ``vehicles`` vehicles."""
    shown = torch.zeros(1, vehicles, steps, 2)
    encoder = discriminator.encoder
    projected = encoder.project(shown[..., 1:, :], shown.diff(dim=-2))
    return [
        Block("displacements", ("observed, then recorded", "or predicted"), _shape(shown)),
        Block("embedding", (f"{encoder.embed.in_features} to {encoder.embed.out_features}, ReLU,",
              "to the LSTM's gates"), _shape(projected), _count(encoder.embed, encoder.input)),
        Block("LSTM encoder", (f"{projected.shape[2]} motions,", "last state"), _shape(encoder.encode(projected)),
              encoder.recurrent.numel()),
        Block("logit", ("recorded or", "predicted"), _shape(discriminator(shown)), _count(discriminator.head)),
    ]  # fmt: skip


def _shape(tensor: Tensor) -> tuple[int, ...]:
    """Without the batch."""
    return tuple(tensor.shape[1:])


def draw_architecture(rows: dict[str, list[Block]]) -> Image.Image:
    """A line of boxes per network (two if it is long), with arrows from each to the next."""
    lines = [
        (name if first == 0 else "", blocks[first : first + _ACROSS], colour)
        for (name, blocks), colour in zip(rows.items(), LINES)
        for first in range(0, len(blocks), _ACROSS)
    ]
    width = 2 * _MARGIN + _ACROSS * _WIDTH + (_ACROSS - 1) * _SPACE
    sheet = Image.new("RGB", (width, _MARGIN + len(lines) * _LINE), PAPER)
    for index, (name, blocks, colour) in enumerate(lines):
        top = _MARGIN + index * _LINE
        put_text(sheet, (_MARGIN, top), name, 15, colour)
        for place, block in enumerate(blocks):
            left = _MARGIN + place * (_WIDTH + _SPACE)
            _draw_block(sheet, left, top + _TITLE, block, colour)
            if place + 1 < len(blocks):
                _draw_arrow(sheet, left + _WIDTH, top + _TITLE + _HEIGHT // 2)
    return sheet


def _draw_block(sheet: Image.Image, left: int, top: int, block: Block, colour: Colour) -> None:
    """A box with its four lines."""
    box = (left, top, left + _WIDTH, top + _HEIGHT)
    ImageDraw.Draw(sheet).rounded_rectangle(box, radius=8, outline=colour, width=2)
    weights = f"{block.parameters} weights" if block.parameters else ""
    shape = "[" + ", ".join(map(str, block.shape)) + "]"
    texts = ((block.title, 14, INK), *((text, 12, FAINT) for text in block.does))
    for line, (text, size, ink) in enumerate(texts):
        put_text(sheet, (left + 10, top + 8 + 20 * line), text, size, ink)
    put_text(sheet, (left + 10, top + _HEIGHT - 28), shape, 14, colour)
    put_text(sheet, (left + _WIDTH - 10, top + _HEIGHT - 26), weights, 12, FAINT, 1.0)


def _draw_arrow(sheet: Image.Image, left: int, middle: int) -> None:
    """From a box to the next."""
    draw, right = ImageDraw.Draw(sheet), left + _SPACE - 4
    draw.line((left + 5, middle, right, middle), fill=FAINT, width=2)
    draw.polygon([(right, middle), (right - 8, middle - 5), (right - 8, middle + 5)], fill=FAINT)
