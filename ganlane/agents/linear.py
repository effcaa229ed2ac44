"""A linear layer that goes through oneDNN on a CPU.

PyTorch sends float32 products to MKL, which uses half the vector width on AMD processors; oneDNN computes the same in
full precision in half the time there, and in no more elsewhere. The operator is one that PyTorch's own compiler
emits; where it is missing, and on every other device or type, :func:`linear` is ``torch.nn.functional.linear``.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

_ONEDNN = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")


def linear(x: Tensor, weight: Tensor, bias: Tensor, relu: bool = False) -> Tensor:
    """``x @ weight.T + bias`` for ``x`` [*, I], ``weight`` [O, I] and ``bias`` [O]; then a ReLU, if asked for."""
    fast = _ONEDNN and x.device.type == "cpu" and x.dtype == torch.float32 and x.dim() == 2
    if fast and not torch.is_grad_enabled():
        return _product(x, weight, bias, relu)
    product = _OneDnnLinear.apply(x, weight, bias) if fast else functional.linear(x, weight, bias)
    return torch.relu(product) if relu else product


def matrix_product(x: Tensor, weight: Tensor, bias: Tensor | None = None, relu: bool = False) -> Tensor:
    """:func:`linear` in 2-d float32 without gradients, as an operator that a compiled graph calls as it is."""
    return torch.ops.ganlane.linear(x, weight, bias, relu)


def _product(x: Tensor, weight: Tensor, bias: Tensor | None = None, relu: bool = False) -> Tensor:
    return torch.ops.mkldnn._linear_pointwise(x, weight, bias, "relu" if relu else "none", [], "")


class _OneDnnLinear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight)
        return _product(x, weight, bias)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        (gradient,), (x, weight) = gradients, ctx.saved_tensors
        to_x = _product(gradient, weight.t()) if ctx.needs_input_grad[0] else None
        return to_x, _product(gradient.t(), x.t()), gradient.sum(0)


# Compiled, oneDNN's own operator is replaced by a slower product or, with transposed weights, not understood.
_LIBRARY = torch.library.Library("ganlane", "FRAGMENT")
_LIBRARY.define("linear(Tensor x, Tensor weight, Tensor? bias, bool relu) -> Tensor")


@torch.library.impl(_LIBRARY, "linear", "CPU")
def _operator(x: Tensor, weight: Tensor, bias: Tensor | None, relu: bool) -> Tensor:
    if _ONEDNN:
        return _product(x, weight, bias, relu)
    product = functional.linear(x, weight, bias)
    return torch.relu(product) if relu else product


@torch.library.register_fake("ganlane::linear")
def _shape(x: Tensor, weight: Tensor, bias: Tensor | None, relu: bool) -> Tensor:
    return x.new_empty((x.shape[0], weight.shape[0]))
