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
def _operator(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    relu: bool,
) -> Tensor:
    """What the operator computes; the arguments are those of :func:`matrix_product`."""
    if ONEDNN:
        after = "relu" if relu else "none"
        # A ReLU has neither numbers nor an algorithm, which other functions would need here.
        return torch.ops.mkldnn._linear_pointwise(x, weight, bias, after, [], "")

    product = functional.linear(x, weight, bias)
    return torch.relu(product) if relu else product


@torch.library.register_fake("ganlane::linear")
def _shape(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    relu: bool,
) -> Tensor:
    """An empty result, from which a compiler learns shape and type without computing."""
    return x.new_empty((*x.shape[:-1], weight.shape[0]))


def has_fast_product(x: Tensor) -> bool:
    """Whether :func:`matrix_product` takes ``x``, and oneDNN is there to compute it."""
    return ONEDNN and x.device.type == "cpu" and x.dtype == torch.float32


def matrix_product(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    relu: bool = False,
) -> Tensor:
    """:func:`linear` in float32 on a CPU, without a gradient, in eager and in compiled graphs.

    Args:
        x: inputs, [..., I].
        weight: [O, I].
        bias: [O]; None: of zeros.
        relu: whether a ReLU follows.
    """
    return torch.ops.ganlane.linear(x, weight, bias, relu)


def linear(
    x: Tensor,
    weight: Tensor,
    bias: Tensor,
    relu: bool = False,
) -> Tensor:
    """``x @ weight.T + bias``, then a ReLU if asked for, with gradients.

    By oneDNN where ``x`` is float32 on a CPU and has two dimensions.

    Args:
        x: inputs, [..., I].
        weight: [O, I].
        bias: [O].
        relu: whether a ReLU follows.
    """
    if not has_fast_product(x) or x.dim() != 2:
        product = functional.linear(x, weight, bias)
    elif torch.is_grad_enabled():
        product = _OneDnnLinear.apply(x, weight, bias)
    else:
        # The ReLU in one pass with the product.
        return matrix_product(x, weight, bias, relu)
    return torch.relu(product) if relu else product


class _OneDnnLinear(torch.autograd.Function):
    """oneDNN's operator has no gradient of its own: it is two more products."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """The product [B, O] of inputs [B, I]."""
        ctx.save_for_backward(x, weight)
        return matrix_product(x, weight, bias)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        """Gradients of inputs, weight and bias, from that of the product [B, O]."""
        (gradient,) = gradients
        x, weight = ctx.saved_tensors

        # The first layer's inputs are data and need none: that saves a product.
        to_x = None
        if ctx.needs_input_grad[0]:
            to_x = matrix_product(gradient, weight.t())
        to_weight = matrix_product(gradient.t(), x.t())
        to_bias = gradient.sum(0)
        return to_x, to_weight, to_bias
