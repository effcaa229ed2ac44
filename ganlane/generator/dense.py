"""Dense layers for driving: oneDNN's float32 product where it is there, in place of MKL's.

``torch.nn.functional.linear`` has float32 multiplied by MKL. On processors other than Intel's that leaves much of
the vector units idle: on an AMD EPYC with AVX-512 oneDNN took a third of the time for the pooling's second layer
([41472, 48] by [48, 32]) and half of it for the LSTM's recurrence ([4608, 32] by [32, 128]), with equal results.
oneDNN's operator has no gradient, and costs more than it saves on a few rows.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

#: From so many rows on oneDNN is the faster one.
_MANY_ROWS = 512
_ONEDNN = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")


def dense(x: Tensor, weight: Tensor, bias: Tensor | None = None, relu: bool = False) -> Tensor:
    """``x`` [..., I] by ``weight`` [O, I], plus ``bias`` [O], through a ReLU if asked for; [..., O]."""
    if not _by_onednn(x):
        out = nn.functional.linear(x, weight, bias)
        return torch.relu(out) if relu else out
    if torch.compiler.is_compiling():
        return _opaque(x, weight, bias, relu)
    return _onednn(x, weight, bias, relu)


def apply(layer: nn.Linear, x: Tensor, relu: bool = False) -> Tensor:
    """``layer(x)`` by :func:`dense`."""
    return dense(x, layer.weight, layer.bias, relu)


def _by_onednn(x: Tensor) -> bool:
    plain = x.device.type == "cpu" and x.dtype == torch.float32
    many = x.numel() >= _MANY_ROWS * x.shape[-1]
    return _ONEDNN and plain and many and not torch.is_grad_enabled()


def _onednn(x: Tensor, weight: Tensor, bias: Tensor | None, relu: bool) -> Tensor:
    return torch.ops.mkldnn._linear_pointwise(x, weight, bias, "relu" if relu else "none", [], "")


# In a graph the operator is reserved for constant weights, so the graph calls it through one of our own.
@torch.library.custom_op("ganlane::dense", mutates_args=())
def _opaque(x: Tensor, weight: Tensor, bias: Tensor | None, relu: bool) -> Tensor:
    return _onednn(x, weight, bias, relu)


@_opaque.register_fake
def _shape(x: Tensor, weight: Tensor, bias: Tensor | None, relu: bool) -> Tensor:
    return x.new_empty((*x.shape[:-1], weight.shape[0]))
