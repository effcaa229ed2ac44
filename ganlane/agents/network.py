"""The Q-network: two noisy hidden layers, a dueling head, a distribution over returns.

The paper (V.A) asks for 'two NoisyLinear layers, as defined in Rainbow, with 256 neurons'. Our reading: one trunk
of two noisy hidden layers with ReLU, shared by the value and the advantage, and one noisy linear head that gives
both. Rainbow's own streams are noisy layer, ReLU, noisy layer on top of a convolutional trunk; there is no
convolution here, and a second hidden layer per stream would cost half as much again for the same depth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import pairwise
from math import isfinite

import torch
from torch import Tensor, nn
from torchrl.modules import NoisyLinear

from ganlane.agents.encoder import make_encoder
from ganlane.agents.linear import linear
from ganlane.errors import UserError
from ganlane.parameters.agent import RainbowConfig

#: Weight and bias of each layer.
Weights = list[tuple[Tensor, Tensor]]
#: No layer is wider: a damaged file must not ask for all memory.
LARGEST = 65536


@dataclass(frozen=True)
class NetworkConfig:
    """Shape and options of a :class:`QNetwork`.

    ``observation_size`` D and ``actions`` A come from the environment. ``v_min`` and ``v_max`` bound the discounted
    return, with ``atoms`` points between; without ``distributional`` they are ignored. ``noisy_sigma`` is the
    initial noise of Fortunato et al. 2017 (0.5), divided there by the root of the layer's width. ``encoder`` stands
    before the noisy layers and has no noise (:func:`ganlane.agents.encoder.make_encoder`).
    """

    observation_size: int
    actions: int = 3
    hidden: tuple[int, ...] = (256, 256)
    encoder: str = "none"
    encoder_width: int = 64
    encoder_layers: int = 2
    noisy: bool = True
    dueling: bool = True
    distributional: bool = True
    atoms: int = 51
    v_min: float = -120.0
    v_max: float = 120.0
    noisy_sigma: float = 0.5

    @classmethod
    def of(cls, config: RainbowConfig, observation_size: int, actions: int = 3) -> NetworkConfig:
        """The network of an agent for observations of size D and A actions."""
        shared = {own.name: getattr(config, own.name) for own in fields(cls) if hasattr(config, own.name)}
        return cls(observation_size=observation_size, actions=actions, **shared)

    def __post_init__(self) -> None:
        sizes = {name: getattr(self, name) for name in ("observation_size", "actions", "atoms")}
        sizes |= {"encoder_width": self.encoder_width, "encoder_layers": self.encoder_layers}
        sizes |= {f"hidden[{i}]": width for i, width in enumerate(self.hidden)}
        for name, size in sizes.items():
            if not isinstance(size, int) or not 1 <= size <= LARGEST:
                raise UserError(f"network {name}={size!r}: expected a whole number from 1 to {LARGEST}.")
        for name in ("noisy", "dueling", "distributional"):
            if not isinstance(getattr(self, name), bool):
                raise UserError(f"network {name}={getattr(self, name)!r}: expected true or false.")
        ends = (self.v_min, self.v_max, self.noisy_sigma)
        if not all(isinstance(end, int | float) and isfinite(end) for end in ends) or self.v_min >= self.v_max:
            raise UserError(f"network v_min={self.v_min!r}, v_max={self.v_max!r}: expected finite numbers in order.")

    @property
    def outputs(self) -> int:
        """Numbers per action: the atoms of the distribution, or one value."""
        return self.atoms if self.distributional else 1


class QNetwork(nn.Module):
    """Action values [*, A], as a distribution over ``support`` [atoms] or as plain numbers.

    Noise is added under ``ExplorationType.RANDOM`` alone and stays the same until it is drawn anew
    (:func:`ganlane.agents.noise.redraw_noise`).

    Raises:
        UserError: the encoder does not exist or cannot read observations of this size.
    """

    support: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = make_encoder(
            config.encoder, config.observation_size, config.encoder_width, config.encoder_layers
        )
        inputs = config.observation_size if self.encoder is None else self.encoder.outputs
        widths = (inputs, *config.hidden)
        self.trunk = nn.ModuleList(self._linear(*pair) for pair in pairwise(widths))
        rows = config.actions + int(config.dueling)
        self.head = self._linear(widths[-1], rows * config.outputs)
        self.register_buffer("support", torch.linspace(config.v_min, config.v_max, config.atoms), persistent=False)

    def _linear(self, inputs: int, outputs: int) -> nn.Linear:
        if self.config.noisy:
            return NoisyLinear(inputs, outputs, std_init=self.config.noisy_sigma)
        return nn.Linear(inputs, outputs)

    def weights(self) -> Weights:
        """Weight and bias of every layer after the encoder, the head last, with the present noise added."""
        return [(layer.weight, layer.bias) for layer in (*self.trunk, self.head)]

    def logits(self, observation: Tensor, weights: Weights | None = None) -> Tensor:
        """Unnormalised output [*, A, atoms] (atoms is 1 when not distributional) for observations [*, D].

        ``weights`` of :meth:`weights` save composing them again when several batches see the same noise.
        """
        *hidden_layers, head = self.weights() if weights is None else weights
        hidden = observation.to(self.support.dtype)
        if self.encoder is not None:
            hidden = self.encoder(hidden)
        for weight, bias in hidden_layers:
            hidden = linear(hidden, weight, bias, relu=True)
        rows = linear(hidden, *head).unflatten(-1, (-1, self.config.outputs))
        return duel(rows) if self.config.dueling else rows

    def forward(self, observation: Tensor) -> Tensor:
        """What TorchRL's actors and losses expect: log-probabilities [*, atoms, A], or values [*, A]."""
        logits = self.logits(observation)
        if self.config.distributional:
            return logits.log_softmax(-1).transpose(-1, -2)
        return logits.squeeze(-1)

    def expected(self, logits: Tensor) -> Tensor:
        """Action values [*, A] of the ``logits`` [*, A, atoms]."""
        if self.config.distributional:
            return logits.softmax(-1) @ self.support
        return logits.squeeze(-1)

    def values(self, observation: Tensor) -> Tensor:
        """Action values [*, A]: expected discounted returns."""
        return self.expected(self.logits(observation))


def duel(rows: Tensor) -> Tensor:
    """Join value (row 0) and advantages (the rest) of [*, 1 + A, atoms] into [*, A, atoms] (Wang et al. 2016)."""
    value, advantage = rows[..., :1, :], rows[..., 1:, :]
    return value + advantage - advantage.mean(-2, keepdim=True)


def parameters_of(network: QNetwork) -> dict[str, Tensor]:
    """Copies of the parameters by name; the momentary noise is not among them."""
    return {name: value.detach().clone() for name, value in network.named_parameters()}


@torch.no_grad()
def load_parameters(network: QNetwork, weights: Mapping[str, Tensor]) -> None:
    """Copy ``weights`` into the parameters of ``network``, in place.

    Raises:
        UserError: names or shapes differ.
    """
    own = dict(network.named_parameters())
    shapes = {name: tuple(value.shape) for name, value in own.items()}
    given = {name: tuple(value.shape) for name, value in weights.items()}
    if shapes != given:
        differing = sorted(name for name in shapes.keys() | given.keys() if shapes.get(name) != given.get(name))
        name = differing[0]
        raise UserError(
            f"the weights do not fit the network: {name} is {given.get(name, 'absent')} in the checkpoint and "
            f"{shapes.get(name, 'absent')} in the network; use the observation and agent options it was trained with."
        )
    for name, value in own.items():
        value.copy_(weights[name])
