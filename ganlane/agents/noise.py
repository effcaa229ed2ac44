"""The noise of the noisy layers (Fortunato et al. 2017): drawn when asked, from a generator of one's own."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.modules import NoisyLinear


def noisy_layers(module: nn.Module) -> list[NoisyLinear]:
    """Every noisy layer of ``module``, in a fixed order."""
    return [layer for layer in module.modules() if isinstance(layer, NoisyLinear)]


@torch.no_grad()
def redraw_noise(module: nn.Module, generator: torch.Generator) -> None:
    """Draw the factorised Gaussian noise of every noisy layer anew.

    In place of TorchRL's ``reset_noise``, which draws from the global generator; one draw serves all layers.
    """
    layers = noisy_layers(module)
    if not layers:
        return
    sizes = [size for layer in layers for size in (layer.in_features, layer.out_features)]
    normal = torch.randn(sum(sizes), generator=generator, device=generator.device)
    noise = (normal.sign() * normal.abs().sqrt()).split(sizes)
    for layer, inputs, outputs in zip(layers, noise[::2], noise[1::2]):
        torch.outer(outputs, inputs, out=layer.weight_epsilon)
        layer.bias_epsilon.copy_(outputs)


def mean_sigma(module: nn.Module) -> Tensor:
    """Mean absolute noise parameter over the weights of the noisy layers, 0-dim; 0 without noise."""
    layers = noisy_layers(module)
    if not layers:
        return torch.zeros(())
    return torch.stack([layer.weight_sigma.detach().abs().mean() for layer in layers]).mean()
