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


def dense(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    relu: bool = False,
) -> Tensor:
    """A linear layer [..., O].

    Args:
        x: inputs, [..., I].
        weight: [O, I].
        bias: [O]; None: of zeros.
        relu: whether a ReLU follows.
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
    """Network inputs [..., 4] of a motion; typical values are about 1.

    Args:
        displacement: along and across the road, m per 0.1 s, [..., 2].
        difference: its change since the step before, m, [..., 2].
    """
    scaled = displacement / constant(DISPLACEMENT_SCALE_M, displacement)
    change = difference / constant(DIFFERENCE_SCALE_M, difference)
    change = change.clamp(-LARGEST_DIFFERENCE, LARGEST_DIFFERENCE)
    return torch.cat([scaled, change], dim=-1)


class MotionLSTM(nn.Module):
    """Embedding with ReLU, then an LSTM cell.

    The cell is in two parts, the projection of the input and the recurrence. The gates are ordered
    input, forget, output, new: the three with a sigmoid are adjacent.

    Args:
        embedding: width of the embedding.
        hidden: width H of the state.
        differences: without, the displacements' differences are 0 as inputs (an ablation).
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

        # The forget gate is open at the start of the fit.
        with torch.no_grad():
            self.input.bias[hidden : 2 * hidden].fill_(1.0)

    def project(self, displacement: Tensor, difference: Tensor) -> Tensor:
        """Part of the gates [..., 4H] that depends on this motion alone, so it can be kept.

        The arguments are those of :func:`motion_features`.
        """
        if not self.differences:
            difference = torch.zeros_like(difference)
        features = motion_features(displacement, difference)
        embedded = apply(self.embed, features, relu=True)
        return apply(self.input, embedded)

    def project_course(self, displacements: Tensor) -> tuple[Tensor, ...]:
        """Projections [..., 4H] of T displacements [..., T, 2], one for each of T - 1 motions."""
        # The first displacement has no difference to one before it, so it is no motion.
        differences = displacements.diff(dim=-2)
        projections = self.project(displacements[..., 1:, :], differences)
        return projections.unbind(dim=-2)

    def step(self, projected: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
        """One recurrence on a projection [..., 4H] and state ([..., H], [..., H]).

        Returns the new state.
        """
        # In place, since nobody else has the product.
        gates = dense(hidden, self.recurrent).add_(projected)
        return self._update(gates, cell)

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
        """The new hidden and cell states [..., H] from gates [..., 4H] and the old cell state."""
        width = cell.shape[-1]
        sigmoids = torch.sigmoid(gates[..., : 3 * width])
        write, forget, read = sigmoids.chunk(3, dim=-1)
        new = gates[..., 3 * width :]

        # The LSTM's update: c = i * tanh(g) + f * c, h = o * tanh(c).
        cell = _times_tanh(write, new) + forget * cell
        return _times_tanh(read, cell), cell


def _times_tanh(factor: Tensor, x: Tensor) -> Tensor:
    """``factor * tanh(x)`` by the sigmoid: on a CPU a quarter of the time of ``torch.tanh``."""
    # tanh(x) = 2 sigmoid(2 x) - 1.
    return torch.addcmul(-factor, factor, torch.sigmoid(x + x), value=2.0)


def nearest(position: Tensor, valid: Tensor, neighbours: int) -> tuple[Tensor | None, Tensor]:
    """The nearest other vehicles of each vehicle.

    Args:
        position: of the vehicles, [B, G, 2] in m.
        valid: which of them are no padding, [B, G].
        neighbours: K, how many are wanted.

    Returns:
        Their indices [B, G, K], and a mask [B, G, K] that is false for padding, the vehicle itself
        and beyond :data:`RANGE_M`. If there are not more vehicles than K, the indices are None and
        K is G: all vehicles in order.
    """
    count = position.shape[-2]
    # [B, G, G, 2], other minus self.
    offset = position[..., None, :, :] - position[..., :, None, :]

    # A vehicle is not its own neighbour.
    itself = torch.eye(count, dtype=torch.bool, device=position.device)
    in_range = offset[..., 0].abs() <= RANGE_M
    real = valid[..., None, :] & ~itself & in_range
    if count - 1 <= neighbours:
        return None, real

    # Squared distances order vehicles as well as distances do.
    squared = (offset * offset).sum(-1).masked_fill(~real, torch.inf)
    index = squared.topk(neighbours, dim=-1, largest=False).indices
    return index, real.gather(-1, index)


def gather_vehicles(values: Tensor, index: Tensor | None) -> Tensor:
    """The values of every vehicle's neighbours.

    Args:
        values: of the vehicles, [B, G, F].
        index: of their neighbours, [B, G, K]; None: all vehicles are.

    Returns:
        [B, G, K, F]; without an index [B, 1, G, F], which broadcasts to it.
    """
    if index is None:
        return values[..., None, :, :]
    # gather needs an index as wide as the values.
    flat = index.flatten(1)[..., None].expand(-1, -1, values.shape[-1])
    return values.gather(1, flat).unflatten(1, index.shape[1:])


class PairPooling(nn.Module):
    """Max pooling of two layers over each vehicle's nearest neighbours; zeros where there is none.

    Args:
        hidden: width H of the vehicles' states.
        inner: width of the first layer.
        pooled: width P of the result.
        neighbours: how many count; 0: no pooling.
    """

    def __init__(
        self,
        hidden: int,
        inner: int,
        pooled: int,
        neighbours: int,
    ):
        super().__init__()
        self.neighbours = neighbours
        # Only this layer has a bias, since the two terms are added.
        self.per_pair = nn.Linear(len(_PAIR_SCALE), inner)
        self.per_vehicle = nn.Linear(hidden, inner, bias=False)
        self.second = nn.Linear(inner, pooled)

    def forward(
        self,
        hidden: Tensor,
        position: Tensor,
        displacement: Tensor,
        valid: Tensor,
    ) -> Tensor:
        """Pooled states [B, G, P] of the vehicles.

        Args:
            hidden: states of the encoder, [B, G, H].
            position: m, [B, G, 2].
            displacement: the last one, m per 0.1 s, [B, G, 2].
            valid: which vehicles are no padding, [B, G].
        """
        if self.neighbours == 0:
            return hidden.new_zeros(*hidden.shape[:-1], self.second.out_features)
        index, real = nearest(position, valid, self.neighbours)

        # Relative to the first vehicle: far down the road, differences of float32 positions lose
        # digits.
        place = position - position[..., :1, :]
        state = torch.cat([place, displacement], dim=-1)
        state = state / constant(_PAIR_SCALE, position)

        # The first layer is linear in (other - self), so it runs once per vehicle, not per pair.
        itself = nn.functional.linear(state, self.per_pair.weight)
        terms = apply(self.per_vehicle, hidden) + itself + self.per_pair.bias
        of_neighbours = gather_vehicles(terms, index)
        first = (of_neighbours - itself[..., None, :]).relu_()

        # So much is subtracted where masked that the maximum ignores it.
        second = apply(self.second, first).add_(~real[..., None], alpha=-1e9)
        # The ReLU comes after the maximum, which it does not change: fewer numbers. Where everybody
        # is masked, it gives 0.
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

        # What the context leaves of the decoder's hidden state is the noise's.
        inputs = sizes.hidden + sizes.pooled + sizes.extra_inputs
        self.context = nn.Sequential(
            nn.Linear(inputs, sizes.context),
            nn.ReLU(),
            nn.Linear(sizes.context, sizes.hidden - sizes.noise),
        )

        self.decoder = MotionLSTM(sizes.embedding, sizes.hidden, sizes.differences)
        self.head = nn.Linear(sizes.hidden, 2)

    def observe(self, displacements: Tensor, position: Tensor, valid: Tensor) -> Observation:
        """The input of recorded vehicles, without further inputs.

        Args:
            displacements: the observed ones, oldest first, [B, G, observed, 2], m per 0.1 s.
            position: the last one, [B, G, 2], m.
            valid: which vehicles are no padding, [B, G].
        """
        last = displacements[..., -1, :]
        return Observation(
            projections=self.encoder.project_course(displacements),
            displacement=last,
            difference=last - displacements[..., -2, :],
            position=position,
            valid=valid,
            # Of width 0: the paper's preset has none.
            extra=last[..., :0],
        )

    def summarise(self, now: Observation) -> Tensor:
        """Context [B, G, H - Z] of every vehicle.

        Its own motion, its neighbours, its further inputs.
        """
        hidden = self.encoder.encode(now.projections)
        pooled = self.pooling(hidden, now.position, now.displacement, now.valid)
        inputs = torch.cat([hidden, pooled, now.extra], dim=-1)

        # The layers are applied by hand, through the fast product; layer 1 is the ReLU.
        first = cast(nn.Linear, self.context[0])
        second = cast(nn.Linear, self.context[2])
        inner = apply(first, inputs, relu=True)
        return apply(second, inner)

    def decode(
        self,
        context: Tensor,
        noise: Tensor,
        now: Observation,
        steps: int,
    ) -> Tensor:
        """Output [..., steps, 2] of the decoder's first steps, in units of ``DIFFERENCE_SCALE_M``.

        Each output is the change of the displacement that the next step continues.

        Args:
            context: of the vehicles (:meth:`summarise`), [..., H - Z].
            noise: [..., Z]; leading dimensions broadcast with the context's, so that several
                samples share one context.
            now: the vehicles' last displacements.
            steps: of 0.1 s.
        """
        # The decoder's first hidden state is context and noise side by side.
        leading = torch.broadcast_shapes(context.shape[:-1], noise.shape[:-1])
        context = context.expand(*leading, -1)
        noise = noise.expand(*leading, -1)
        hidden = torch.cat([context, noise], dim=-1)
        cell = torch.zeros_like(hidden)

        scale = constant(DIFFERENCE_SCALE_M, hidden)
        displacement = now.displacement
        difference = now.difference
        outputs = []
        for _ in range(steps):
            projected = self.decoder.project(displacement, difference)
            hidden, cell = self.decoder.step(projected, hidden, cell)
            output = apply(self.head, hidden)
            outputs.append(output)

            # What it predicts is the next step's input.
            difference = output * scale
            displacement = displacement + difference
        return torch.stack(outputs, dim=-2)

    def forward(self, now: Observation, noise: Tensor, steps: int | None = None) -> Tensor:
        """Predicted displacements [..., steps, 2], m per 0.1 s.

        Args:
            now: B groups of G vehicles.
            noise: [..., B, G, Z].
            steps: of 0.1 s; None: as many as the sizes say.
        """
        context = self.summarise(now)
        outputs = self.decode(context, noise, now, steps or self.sizes.predicted)
        return displacements_of(outputs, now.displacement)


def displacements_of(outputs: Tensor, last: Tensor) -> Tensor:
    """Displacements [..., steps, 2] in m per 0.1 s, from the decoder's outputs.

    The outputs are changes, so an output of 0 repeats the last displacement.

    Args:
        outputs: of :meth:`Generator.decode`, [..., steps, 2].
        last: the displacement before them, m per 0.1 s, [..., 2].
    """
    changes = outputs.cumsum(dim=-2) * constant(DIFFERENCE_SCALE_M, outputs)
    return last[..., None, :] + changes


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
