"""The Q-network: two noisy hidden layers, a dueling head, a distribution over returns.

The paper (V.A) asks for 'two NoisyLinear layers, as defined in Rainbow, with 256 neurons'. Our
reading: one trunk of two noisy hidden layers with ReLU, shared by the value and the advantage, and
one noisy linear head that gives both. Rainbow's own streams are noisy layer, ReLU, noisy layer on
top of a convolutional trunk; there is no convolution here, and a second hidden layer per stream
would cost half as much again for the same depth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.modules import NoisyLinear

from ganlane.errors import UserError
from ganlane.linear import linear
from ganlane.settings.agent import RainbowConfig

#: Weight and bias of each layer.
Weights = list[tuple[Tensor, Tensor]]
#: Options of an agent that shape its network; the support is ignored unless it is distributional.
SHAPE = ("hidden", "noisy", "dueling", "distributional", "atoms", "v_min", "v_max", "noisy_sigma")
#: Largest width of a layer: a damaged file must not ask for all memory.
LARGEST = 65536


@dataclass(frozen=True)
class NetworkConfig:
    """The form of a network.

    Attributes:
        agent: gives layers, noise and distribution (:data:`SHAPE`).
        observation_size: D.
        actions: A.

    Raises:
        UserError: a layer would be empty or too large.
    """

    agent: RainbowConfig
    observation_size: int
    actions: int = 3

    def __post_init__(self) -> None:
        sizes = {
            "observation_size": self.observation_size,
            "actions": self.actions,
            "atoms": self.agent.atoms,
        }
        for i, width in enumerate(self.agent.hidden):
            sizes[f"hidden[{i}]"] = width
        for name, size in sizes.items():
            if type(size) is not int or not 1 <= size <= LARGEST:
                raise UserError(
                    f"network {name}={size!r}: expected a whole number from 1 to {LARGEST}."
                )

    @property
    def outputs(self) -> int:
        """Numbers per action: the atoms of the distribution, or one value."""
        return self.agent.atoms if self.agent.distributional else 1

    def description(self) -> dict[str, Any]:
        """Plain data for a file, which :meth:`described` reads."""
        return {
            "observation_size": self.observation_size,
            "actions": self.actions,
            **{name: getattr(self.agent, name) for name in SHAPE},
        }

    @classmethod
    def described(cls, description: Mapping[str, Any]) -> NetworkConfig:
        """The network of a :meth:`description`.

        Raises:
            UserError: an entry is missing, unknown, or no such value.
        """
        expected_names = ("actions", "observation_size", *SHAPE)
        if description.keys() != {*expected_names}:
            raise UserError(f"expected the entries {', '.join(expected_names)}")
        # The record checks the types of the values.
        options = RainbowConfig(**{name: description[name] for name in SHAPE})
        return cls(options, description["observation_size"], description["actions"])


class QNetwork(nn.Module):
    """Action values [*, A], as a distribution over ``support`` [atoms] or as plain numbers.

    Noise is added under ``ExplorationType.RANDOM`` alone, and is the same until
    :func:`redraw_noise`.

    Attributes:
        support: returns that the atoms stand for, [atoms].
        trunk: the hidden layers.
        head: the last layer, [(1 +) A atoms] outputs.
    """

    support: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        options = config.agent
        layer = partial(NoisyLinear, std_init=options.noisy_sigma) if options.noisy else nn.Linear

        widths = (config.observation_size, *options.hidden)
        self.trunk = nn.ModuleList(layer(*pair) for pair in pairwise(widths))
        # A dueling head has one row more, the value.
        rows = config.actions + options.dueling
        self.head = layer(widths[-1], rows * config.outputs)

        support = torch.linspace(options.v_min, options.v_max, options.atoms)
        # Not persistent: an agent's file has the bounds of the support in its description.
        self.register_buffer("support", support, persistent=False)

    def weights(self) -> Weights:
        """Weight and bias of every layer, the head last, with the present noise added."""
        return [(layer.weight, layer.bias) for layer in (*self.trunk, self.head)]

    def logits(self, observation: Tensor, weights: Weights | None = None) -> Tensor:
        """Unnormalised output [*, A, atoms]; atoms is 1 when not distributional.

        Args:
            observation: [*, D], of any float type.
            weights: of :meth:`weights`; they save composing them again when several batches see
                the same noise. None: with the noise at this moment.
        """
        if weights is None:
            weights = self.weights()
        *hidden_layers, head = weights
        hidden = observation.to(self.support.dtype)
        for weight, bias in hidden_layers:
            hidden = linear(hidden, weight, bias, relu=True)
        # [*, (1 +) A, atoms]
        rows = linear(hidden, *head).unflatten(-1, (-1, self.config.outputs))
        return duel(rows) if self.config.agent.dueling else rows

    def forward(self, observation: Tensor) -> Tensor:
        """What TorchRL's actors and losses expect.

        Log-probabilities [*, atoms, A], or values [*, A].
        """
        logits = self.logits(observation)
        # TorchRL wants log probabilities with the actions last.
        if self.config.agent.distributional:
            return logits.log_softmax(-1).transpose(-1, -2)
        return logits.squeeze(-1)

    def expected(self, logits: Tensor) -> Tensor:
        """Action values [*, A] of the ``logits`` [*, A, atoms]: the means of the distributions."""
        if self.config.agent.distributional:
            return logits.softmax(-1) @ self.support
        return logits.squeeze(-1)

    def values(self, observation: Tensor) -> Tensor:
        """Action values [*, A]: expected discounted returns."""
        return self.expected(self.logits(observation))


def allowed_values(values: Tensor, mask: Tensor | None) -> Tensor:
    """Action values [*, A] with minus infinity where ``mask`` [*, A] forbids.

    Unchanged without a mask.
    """
    return values if mask is None else values.masked_fill(~mask, -torch.inf)


def duel(rows: Tensor) -> Tensor:
    """Join value (row 0) and advantages (the rest) of [*, 1 + A, atoms] into [*, A, atoms] (Wang et
    al. 2016, equation 9).
    """
    value = rows[..., :1, :]
    advantage = rows[..., 1:, :]
    # Without the mean taken off, value and advantages could shift against each other.
    return value + advantage - advantage.mean(-2, keepdim=True)


def parameters_of(network: QNetwork) -> dict[str, Tensor]:
    """Copies of the parameters by name, without the momentary noise."""
    return {name: value.detach().clone() for name, value in network.named_parameters()}


@torch.no_grad()
def load_parameters(network: QNetwork, weights: Mapping[str, Tensor]) -> None:
    """Copy ``weights`` into the parameters of ``network``, in place.

    Raises:
        UserError: names or shapes differ.
    """
    parameters = dict(network.named_parameters())

    # Names and shapes first: nothing is copied where one of them differs.
    expected = {name: tuple(value.shape) for name, value in parameters.items()}
    shapes = {name: tuple(value.shape) for name, value in weights.items()}
    for name in sorted(expected.keys() | shapes.keys()):
        if shapes.get(name) != expected.get(name):
            raise UserError(
                f"the weights do not fit the network: {name} is {shapes.get(name, 'absent')} in "
                f"the checkpoint and {expected.get(name, 'absent')} in the network; use the "
                "observation and agent options it was trained with."
            )

    for name, parameter in parameters.items():
        parameter.copy_(weights[name])


@torch.no_grad()
def redraw_noise(network: nn.Module, generator: torch.Generator) -> None:
    """Draw the factorised Gaussian noise of every noisy layer anew (Fortunato et al. 2017).

    In place of TorchRL's ``reset_noise``, which draws from the global generator; one draw serves
    all layers.
    """
    noise = noise_of(network, generator)
    for layer, (inputs, outputs) in zip(noisy_layers(network), noise):
        # In place: the layer's buffers, which its forward adds.
        torch.outer(outputs, inputs, out=layer.weight_epsilon)
        layer.bias_epsilon.copy_(outputs)


def noise_of(network: nn.Module, generator: torch.Generator) -> list[tuple[Tensor, Tensor]]:
    """New noise of the inputs and outputs of every noisy layer; empty without such layers."""
    layers = noisy_layers(network)
    if not layers:
        return []
    # Inputs of the first layer, its outputs, inputs of the second one, and so on.
    sizes: list[int] = []
    for layer in layers:
        sizes += [layer.in_features, layer.out_features]

    # One draw for all layers, which is faster than one for each.
    normal = torch.randn(sum(sizes), generator=generator, device=generator.device)
    # f(x) = sgn(x) sqrt(|x|), equation 11 of Fortunato et al.
    noise = normal.sign() * normal.abs().sqrt()
    parts = noise.split(sizes)
    return list(zip(parts[::2], parts[1::2]))


def noisy_layers(network: nn.Module) -> list[NoisyLinear]:
    """All of them, in the order of the modules."""
    return [layer for layer in network.modules() if isinstance(layer, NoisyLinear)]
