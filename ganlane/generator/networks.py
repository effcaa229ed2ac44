"""The Social-GAN's two networks (section III; Gupta et al. 2018) and their layers.

**LSTM.** The projection of an input is separate from the recurrence, so that projections can be
kept when the window of observed motions moves on by one step.

**Pooling.** The original loops over scenes and runs a linear layer on relative position and the
other's state for every pair. That layer is a term of the other vehicle minus a term of one's own:
here both are computed once per vehicle and subtracted per pair. Groups are padded, and only the
nearest vehicles count.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

from ganlane.linear import has_fast_product, matrix_product
from ganlane.settings.generator import GeneratorSizes
from ganlane.torch_settings import constant

# The networks' units are typical values, so that inputs are of order 1.
#: Displacement per 0.1 s, along and across the road, m.
DISPLACEMENT_SCALE_M = (1.0, 0.05)
#: Change of the displacement from one step to the next, along and across the road, m.
DIFFERENCE_SCALE_M = (0.04, 0.02)
#: Changes of displacement are clipped here (in units of the scale): recorded positions sometimes
#: jump.
LARGEST_DIFFERENCE = 5.0
#: Units of a pair's relative position (m) and relative displacement (m per 0.1 s), each along and
#: across the road.
_PAIR_SCALE = (20.0, 4.0, 0.4, 0.05)
#: Vehicles further away than this along the road have no influence, m.
RANGE_M = 100.0
#: From this number of rows on, oneDNN is faster than MKL on the processors that we measured.
_MANY_ROWS = 512


def dense(x: Tensor, weight: Tensor, bias: Tensor | None = None, relu: bool = False) -> Tensor:
    """Linear layer [..., O] of ``x`` [..., I], ``weight`` [O, I] and ``bias`` [O].

    A ReLU follows if ``relu``.
    """
    many = x.numel() >= _MANY_ROWS * x.shape[-1]
    # A fit needs gradients, which the fast product does not have.
    if many and has_fast_product(x) and not torch.is_grad_enabled():
        return matrix_product(x, weight, bias, relu)
    product = nn.functional.linear(x, weight, bias)
    return torch.relu(product) if relu else product


def apply(layer: nn.Linear, x: Tensor, relu: bool = False) -> Tensor:
    """``layer(x)`` computed by :func:`dense`."""
    return dense(x, layer.weight, layer.bias, relu)


def motion_features(displacement: Tensor, difference: Tensor) -> Tensor:
    """Network inputs [..., 4] of a motion.

    ``displacement`` [..., 2] is in m per 0.1 s, ``difference`` [..., 2] its change to the step
    before, in m.
    """
    # Typical values become about 1.
    scaled = displacement / constant(DISPLACEMENT_SCALE_M, displacement)
    change = difference / constant(DIFFERENCE_SCALE_M, difference)
    change = change.clamp(-LARGEST_DIFFERENCE, LARGEST_DIFFERENCE)
    return torch.cat([scaled, change], dim=-1)


class MotionLSTM(nn.Module):
    """Embedding with ReLU, then an LSTM cell.

    The cell is in two parts, the projection of the input and the recurrence. The gates are ordered
    input, forget, output, new: the three with a sigmoid are adjacent. ``hidden`` is the width H of
    the state; without ``differences`` the displacements' differences are 0 as inputs (an ablation).
    """

    def __init__(self, embedding: int, hidden: int, differences: bool = True):
        super().__init__()
        self.hidden = hidden
        self.differences = differences
        self.embed = nn.Linear(4, embedding)
        self.input = nn.Linear(embedding, 4 * hidden)
        self.recurrent = nn.Parameter(torch.empty(4 * hidden, hidden))
        # The bound that torch uses for its own LSTM.
        bound = 1.0 / math.sqrt(hidden)
        nn.init.uniform_(self.recurrent, -bound, bound)
        with torch.no_grad():
            # The forget gate is open at the start of the fit.
            self.input.bias[hidden : 2 * hidden].fill_(1.0)

    def project(self, displacement: Tensor, difference: Tensor) -> Tensor:
        """Part of the gates [..., 4H] that depends on this motion alone, so it can be kept."""
        if not self.differences:
            difference = torch.zeros_like(difference)
        features = motion_features(displacement, difference)
        return apply(self.input, apply(self.embed, features, relu=True))

    def project_course(self, displacements: Tensor) -> tuple[Tensor, ...]:
        """Projections [..., 4H] of T displacements [..., T, 2], one for each of T - 1 motions."""
        return self.project(displacements[..., 1:, :], displacements.diff(dim=-2)).unbind(dim=-2)

    def step(self, projected: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
        """One recurrence on a projection [..., 4H] and state ([..., H], [..., H]).

        Returns the new state.
        """
        return self._update(dense(hidden, self.recurrent).add_(projected), cell)

    def encode(self, projections: Sequence[Tensor]) -> Tensor:
        """Last hidden state [..., H] after projections [..., 4H], from a state of zeros on."""
        # The recurrence of a hidden state of zeros adds nothing, so the first step does without.
        no_cell = torch.zeros_like(projections[0][..., : self.hidden])
        hidden, cell = self._update(projections[0], no_cell)
        for projected in projections[1:]:
            hidden, cell = self.step(projected, hidden, cell)
        return hidden

    @staticmethod
    def _update(gates: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
        width = cell.shape[-1]
        write, forget, read = torch.sigmoid(gates[..., : 3 * width]).chunk(3, dim=-1)
        # The LSTM's update: c = i * tanh(g) + f * c, h = o * tanh(c).
        cell = _times_tanh(write, gates[..., 3 * width :]) + forget * cell
        return _times_tanh(read, cell), cell


def _times_tanh(factor: Tensor, x: Tensor) -> Tensor:
    """``factor * tanh(x)`` by the sigmoid: on a CPU a quarter of the time of ``torch.tanh``."""
    return torch.addcmul(-factor, factor, torch.sigmoid(x + x), value=2.0)


def nearest(position: Tensor, valid: Tensor, neighbours: int) -> tuple[Tensor | None, Tensor]:
    """Indices [B, G, K] of the ``neighbours`` nearest other vehicles of each, and a mask of them.

    ``position`` is [B, G, 2] in m, ``valid`` [B, G]. If there are not more vehicles than that, the
    indices are None and K is G: all vehicles in order. The mask [B, G, K] is false for padding, the
    vehicle itself and beyond :data:`RANGE_M`.
    """
    count = position.shape[-2]
    # [B, G, G, 2], other minus self.
    offset = position[..., None, :, :] - position[..., :, None, :]
    # A vehicle is not its own neighbour.
    itself = torch.eye(count, dtype=torch.bool, device=position.device)
    real = valid[..., None, :] & ~itself & (offset[..., 0].abs() <= RANGE_M)
    if count - 1 <= neighbours:
        return None, real
    # Squared distances order vehicles as well as distances do.
    distance = (offset * offset).sum(-1).masked_fill(~real, torch.inf)
    index = distance.topk(neighbours, dim=-1, largest=False).indices
    return index, real.gather(-1, index)


def gather_vehicles(values: Tensor, index: Tensor | None) -> Tensor:
    """Rows [B, G, K, F] of ``values`` [B, G, F] at ``index`` [B, G, K].

    All of them, [B, 1, G, F], without one.
    """
    if index is None:
        return values[..., None, :, :]
    # gather needs an index as wide as the values.
    flat = index.flatten(1)[..., None].expand(-1, -1, values.shape[-1])
    return values.gather(1, flat).unflatten(1, index.shape[1:])


class PairPooling(nn.Module):
    """Max pooling of two layers over each vehicle's nearest neighbours; zeros where there is none.

    ``hidden`` is the width H of the vehicles' states, ``pooled`` the width P of the result; 0
    ``neighbours`` is no pooling.
    """

    def __init__(self, hidden: int, inner: int, pooled: int, neighbours: int):
        super().__init__()
        self.neighbours = neighbours
        # Only this layer has a bias, since the two terms are added.
        self.per_pair = nn.Linear(len(_PAIR_SCALE), inner)
        self.per_vehicle = nn.Linear(hidden, inner, bias=False)
        self.second = nn.Linear(inner, pooled)

    def forward(
        self, hidden: Tensor, position: Tensor, displacement: Tensor, valid: Tensor
    ) -> Tensor:
        """Pooled states [B, G, P] of the vehicles.

        Their states are [B, G, H], positions and displacements [B, G, 2], the mask [B, G].
        """
        if self.neighbours == 0:
            return hidden.new_zeros(*hidden.shape[:-1], self.second.out_features)
        index, real = nearest(position, valid, self.neighbours)
        # Relative to the first vehicle: far down the road, differences of float32 positions lose
        # digits.
        state = torch.cat([position - position[..., :1, :], displacement], dim=-1)
        state = state / constant(_PAIR_SCALE, position)

        # The first layer is linear in (other - self), so it runs once per vehicle, not per pair.
        itself = nn.functional.linear(state, self.per_pair.weight)
        terms = apply(self.per_vehicle, hidden) + itself + self.per_pair.bias
        first = (gather_vehicles(terms, index) - itself[..., None, :]).relu_()

        # So much is subtracted where masked that the maximum ignores it.
        second = apply(self.second, first).add_(~real[..., None], alpha=-1e9)
        return torch.relu(second.amax(dim=-2))


class Observation(NamedTuple):
    """The generator's input for [B, G] vehicles.

    Attributes:
        projections: observed - 1 tensors [B, G, 4H], input projections of the observed motions
            (:meth:`MotionLSTM.project_course`), oldest first. A motion is a displacement and its
            difference to the one before, so 8 displacements are 7 motions.
        displacement, difference: [B, G, 2], the last displacement, m per 0.1 s, and its difference
            to the one before.
        position: [B, G, 2], m, relative to any common point.
        valid, extra: [B, G] bool and [B, G, extra_inputs].
    """

    projections: tuple[Tensor, ...]
    displacement: Tensor
    difference: Tensor
    position: Tensor
    valid: Tensor
    extra: Tensor


class Generator(nn.Module):
    """Encoder, pooling over pairs, context with noise, decoder.

    The decoder's output changes the last displacement: with an output of 0 it predicts constant
    velocity.
    """

    def __init__(self, sizes: GeneratorSizes):
        super().__init__()
        self.sizes = sizes
        self.encoder = MotionLSTM(sizes.embedding, sizes.hidden, sizes.differences)
        self.pooling = PairPooling(sizes.hidden, sizes.pooling, sizes.pooled, sizes.neighbours)
        inputs = sizes.hidden + sizes.pooled + sizes.extra_inputs
        self.context = nn.Sequential(
            nn.Linear(inputs, sizes.context),
            nn.ReLU(),
            nn.Linear(sizes.context, sizes.hidden - sizes.noise),
        )
        self.decoder = MotionLSTM(sizes.embedding, sizes.hidden, sizes.differences)
        self.head = nn.Linear(sizes.hidden, 2)

    def observe(self, displacements: Tensor, position: Tensor, valid: Tensor) -> Observation:
        """The input from observed displacements [B, G, observed, 2], without further inputs."""
        last = displacements[..., -1, :]
        difference = last - displacements[..., -2, :]
        projections = self.encoder.project_course(displacements)
        # Further inputs of width 0: the paper's preset has none.
        return Observation(projections, last, difference, position, valid, last[..., :0])

    def summarise(self, now: Observation) -> Tensor:
        """Context [B, G, H - Z] of every vehicle.

        Its own motion, its neighbours, its further inputs.
        """
        hidden = self.encoder.encode(now.projections)
        pooled = self.pooling(hidden, now.position, now.displacement, now.valid)
        inputs = torch.cat([hidden, pooled, now.extra], dim=-1)
        # The layers are applied by hand, through the fast product.
        first, second = (cast(nn.Linear, self.context[layer]) for layer in (0, 2))
        return apply(second, apply(first, inputs, relu=True))

    def decode(self, context: Tensor, noise: Tensor, now: Observation, steps: int) -> Tensor:
        """Output [..., steps, 2] of the decoder's first steps, in units of ``DIFFERENCE_SCALE_M``.

        ``context`` is [..., H - Z] and ``noise`` [..., Z]; leading dimensions broadcast, so that
        several samples share one context. Each output is the change of the displacement that the
        next step continues.
        """
        leading = torch.broadcast_shapes(context.shape[:-1], noise.shape[:-1])
        # The decoder's first hidden state is context and noise side by side.
        hidden = torch.cat([part.expand(*leading, -1) for part in (context, noise)], dim=-1)
        cell = torch.zeros_like(hidden)
        scale = constant(DIFFERENCE_SCALE_M, hidden)
        displacement, difference = now.displacement, now.difference
        outputs = []
        for _ in range(steps):
            projected = self.decoder.project(displacement, difference)
            hidden, cell = self.decoder.step(projected, hidden, cell)
            output = apply(self.head, hidden)
            outputs.append(output)
            difference = output * scale
            displacement = displacement + difference
        return torch.stack(outputs, dim=-2)

    def forward(self, now: Observation, noise: Tensor, steps: int | None = None) -> Tensor:
        """Predicted displacements [..., steps, 2], m per 0.1 s, for ``noise`` [..., B, G, Z].

        All by default.
        """
        outputs = self.decode(self.summarise(now), noise, now, steps or self.sizes.predicted)
        return displacements_of(outputs, now.displacement)


def displacements_of(outputs: Tensor, last: Tensor) -> Tensor:
    """Displacements [..., steps, 2] that follow ``last`` [..., 2], of the decoder's outputs.

    The outputs are changes, so an output of 0 repeats the last displacement.
    """
    return last[..., None, :] + outputs.cumsum(dim=-2) * constant(DIFFERENCE_SCALE_M, outputs)


class Discriminator(nn.Module):
    """Classifies displacements as recorded or generated.

    Outputs a logit (the original's ReLU cannot say 'fake').
    """

    def __init__(self, embedding: int, hidden: int):
        super().__init__()
        self.encoder = MotionLSTM(embedding, hidden)
        self.head = nn.Sequential(nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 1))

    def forward(self, displacements: Tensor) -> Tensor:
        """Logits [...] that the observed and following displacements [..., T, 2] were recorded."""
        course = self.encoder.project_course(displacements)
        return self.head(self.encoder.encode(course)).squeeze(-1)
