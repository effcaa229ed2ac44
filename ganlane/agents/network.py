"""The Q-network: two noisy hidden layers, a dueling head, a distribution over returns.

The paper (V.A) asks for 'two NoisyLinear layers, as defined in Rainbow, with 256 neurons'. Our
reading: one trunk of two noisy hidden layers with ReLU, shared by the value and the advantage, and
one noisy linear head that gives both. Rainbow's own streams are noisy layer, ReLU, noisy layer on
top of a convolutional trunk; there is no convolution here, and a second hidden layer per stream
would cost half as much again for the same depth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import partial
from itertools import pairwise
from math import isfinite
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.modules import NoisyLinear

from ganlane.errors import UserError
from ganlane.linear import linear
from ganlane.settings.agent import RainbowConfig

#: Weight and bias of each layer.
Weights = list[tuple[Tensor, Tensor]]
#: Largest width of a layer: a damaged file must not ask for all memory.
LARGEST = 65536


@dataclass(frozen=True)
class NetworkConfig:
    """Shape and options of a :class:`QNetwork`; defaults and meaning as in :class:`RainbowConfig`.

    ``observation_size`` D and ``actions`` A come from the environment. Without ``distributional``
    the support (``atoms`` points from ``v_min`` to ``v_max``) is ignored.
    """

    observation_size: int
    actions: int = 3
    hidden: tuple[int, ...] = RainbowConfig.hidden
    noisy: bool = RainbowConfig.noisy
    dueling: bool = RainbowConfig.dueling
    distributional: bool = RainbowConfig.distributional
    atoms: int = RainbowConfig.atoms
    v_min: float = RainbowConfig.v_min
    v_max: float = RainbowConfig.v_max
    noisy_sigma: float = RainbowConfig.noisy_sigma

    @classmethod
    def of(cls, config: RainbowConfig, observation_size: int, actions: int = 3) -> NetworkConfig:
        """The network of an agent for observations of size D and A actions."""
        shared = {
            own.name: getattr(config, own.name) for own in fields(cls) if hasattr(config, own.name)
        }
        return cls(observation_size=observation_size, actions=actions, **shared)

    def __post_init__(self) -> None:
        sizes = {name: getattr(self, name) for name in ("observation_size", "actions", "atoms")}
        for name, size in (
            sizes | {f"hidden[{i}]": width for i, width in enumerate(self.hidden)}
        ).items():
            if not isinstance(size, int) or not 1 <= size <= LARGEST:
                raise UserError(
                    f"network {name}={size!r}: expected a whole number from 1 to {LARGEST}."
                )
        for name in ("noisy", "dueling", "distributional"):
            if not isinstance(getattr(self, name), bool):
                raise UserError(f"network {name}={getattr(self, name)!r}: expected true or false.")
        numbers = (self.v_min, self.v_max, self.noisy_sigma)
        finite = all(isinstance(number, int | float) and isfinite(number) for number in numbers)
        if not finite or self.v_min >= self.v_max:
            raise UserError(
                f"network v_min={self.v_min!r}, v_max={self.v_max!r}: expected finite numbers in order."
            )

    @property
    def outputs(self) -> int:
        """Numbers per action: the atoms of the distribution, or one value."""
        return self.atoms if self.distributional else 1


class QNetwork(nn.Module):
    """Action values [*, A], as a distribution over ``support`` [atoms] or as plain numbers.

    Noise is added under ``ExplorationType.RANDOM`` alone, and is the same until
    :func:`redraw_noise`.
    """

    support: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        layer = partial(NoisyLinear, std_init=config.noisy_sigma) if config.noisy else nn.Linear
        widths = (config.observation_size, *config.hidden)
        self.trunk = nn.ModuleList(layer(*pair) for pair in pairwise(widths))
        self.head = layer(widths[-1], (config.actions + config.dueling) * config.outputs)
        self.register_buffer(
            "support", torch.linspace(config.v_min, config.v_max, config.atoms), persistent=False
        )

    def weights(self) -> Weights:
        """Weight and bias of every layer, the head last, with the present noise added."""
        return [(layer.weight, layer.bias) for layer in (*self.trunk, self.head)]

    def logits(self, observation: Tensor, weights: Weights | None = None) -> Tensor:
        """Unnormalised output [*, A, atoms] (atoms is 1 when not distributional) for observations
        [*, D].

        ``weights`` of :meth:`weights` save composing them again when several batches see the same
        noise.
        """
        *hidden_layers, head = self.weights() if weights is None else weights
        hidden = observation.to(self.support.dtype)
        for weight, bias in hidden_layers:
            hidden = linear(hidden, weight, bias, relu=True)
        rows = linear(hidden, *head).unflatten(-1, (-1, self.config.outputs))
        return duel(rows) if self.config.dueling else rows

    def forward(self, observation: Tensor) -> Tensor:
        """What TorchRL's actors and losses expect.

        Log-probabilities [*, atoms, A], or values [*, A].
        """
        logits = self.logits(observation)
        return (
            logits.log_softmax(-1).transpose(-1, -2)
            if self.config.distributional
            else logits.squeeze(-1)
        )

    def expected(self, logits: Tensor) -> Tensor:
        """Action values [*, A] of the ``logits`` [*, A, atoms]."""
        return (
            logits.softmax(-1) @ self.support if self.config.distributional else logits.squeeze(-1)
        )

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
    al. 2016).
    """
    value, advantage = rows[..., :1, :], rows[..., 1:, :]
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
    own = dict(network.named_parameters())
    shapes, given = (
        {name: tuple(value.shape) for name, value in each.items()} for each in (own, weights)
    )
    if shapes != given:
        name = min(
            name for name in shapes.keys() | given.keys() if shapes.get(name) != given.get(name)
        )
        raise UserError(
            f"the weights do not fit the network: {name} is {given.get(name, 'absent')} in the checkpoint and "
            f"{shapes.get(name, 'absent')} in the network; use the observation and agent options it was trained with."
        )
    for name, value in own.items():
        value.copy_(weights[name])


@torch.no_grad()
def redraw_noise(network: nn.Module, generator: torch.Generator) -> None:
    """Draw the factorised Gaussian noise of every noisy layer anew (Fortunato et al. 2017).

    In place of TorchRL's ``reset_noise``, which draws from the global generator; one draw serves
    all layers.
    """
    for layer, (inputs, outputs) in zip(noisy_layers(network), noise_of(network, generator)):
        torch.outer(outputs, inputs, out=layer.weight_epsilon)
        layer.bias_epsilon.copy_(outputs)


def noise_of(network: nn.Module, generator: torch.Generator) -> list[tuple[Tensor, Tensor]]:
    """New noise of the inputs and of the outputs of every noisy layer; empty without such layers."""
    layers = noisy_layers(network)
    if not layers:
        return []
    sizes = [size for layer in layers for size in (layer.in_features, layer.out_features)]
    normal = torch.randn(sum(sizes), generator=generator, device=generator.device)
    noise = (normal.sign() * normal.abs().sqrt()).split(sizes)
    return list(zip(noise[::2], noise[1::2]))


def noisy_layers(network: nn.Module) -> list[NoisyLinear]:
    """All of them, in the order of the modules."""
    return [layer for layer in network.modules() if isinstance(layer, NoisyLinear)]
