"""The linear layer of all networks: by oneDNN on a CPU.

PyTorch sends float32 products to MKL, which uses half the vector width, or less, on processors
other than Intel's. oneDNN computes them in full precision too, in a third to a half of the time on
an AMD EPYC, and in no more time elsewhere.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

#: Whether there is oneDNN's linear layer, an operator that PyTorch's own compiler emits.
ONEDNN = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")

# oneDNN's operator behind a name of our own. In a compiled graph, the original is replaced by a
# slower product, or refused where the weights are transposed or no constants.
_LIBRARY = torch.library.Library("ganlane", "FRAGMENT")
_LIBRARY.define("linear(Tensor x, Tensor weight, Tensor? bias, bool relu) -> Tensor")


@torch.library.impl(_LIBRARY, "linear", "CPU")
def _operator(x: Tensor, weight: Tensor, bias: Tensor | None, relu: bool) -> Tensor:
    if ONEDNN:
        return torch.ops.mkldnn._linear_pointwise(
            x, weight, bias, "relu" if relu else "none", [], ""
        )
    product = functional.linear(x, weight, bias)
    return torch.relu(product) if relu else product


@torch.library.register_fake("ganlane::linear")
def _shape(x: Tensor, weight: Tensor, bias: Tensor | None, relu: bool) -> Tensor:
    return x.new_empty((*x.shape[:-1], weight.shape[0]))


def has_fast_product(x: Tensor) -> bool:
    """Whether :func:`matrix_product` takes ``x``, and oneDNN is there to compute it."""
    return ONEDNN and x.device.type == "cpu" and x.dtype == torch.float32


def matrix_product(
    x: Tensor, weight: Tensor, bias: Tensor | None = None, relu: bool = False
) -> Tensor:
    """:func:`linear` in float32 on a CPU, without a gradient, in eager and in compiled graphs."""
    return torch.ops.ganlane.linear(x, weight, bias, relu)


def linear(x: Tensor, weight: Tensor, bias: Tensor, relu: bool = False) -> Tensor:
    """``x @ weight.T + bias``, then a ReLU if asked for, with gradients.

    ``x`` is [..., I], ``weight`` [O, I] and ``bias`` [O]; by oneDNN where ``x`` has two dimensions.
    """
    fast = has_fast_product(x) and x.dim() == 2
    if fast and not torch.is_grad_enabled():
        return matrix_product(x, weight, bias, relu)
    product = _OneDnnLinear.apply(x, weight, bias) if fast else functional.linear(x, weight, bias)
    return torch.relu(product) if relu else product


class _OneDnnLinear(torch.autograd.Function):
    """oneDNN's operator has no gradient of its own: it is two more products."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight)
        return matrix_product(x, weight, bias)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        (gradient,), (x, weight) = gradients, ctx.saved_tensors
        to_x = matrix_product(gradient, weight.t()) if ctx.needs_input_grad[0] else None
        return to_x, matrix_product(gradient.t(), x.t()), gradient.sum(0)
