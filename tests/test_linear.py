"""The fast linear layer is the ordinary one."""

import pytest
import torch
from torch.nn import functional

import ganlane.linear
from ganlane.linear import linear, matrix_product


@pytest.mark.parametrize(
    ("rows", "inputs", "outputs"),
    [(1, 1, 1), (7, 29, 13), (256, 64, 51)],
)
def test_values_and_gradients_are_those_of_torch(rows, inputs, outputs):
    torch.manual_seed(0)
    tensors = [
        torch.randn(rows, inputs),
        torch.randn(outputs, inputs),
        torch.randn(outputs),
    ]
    tensors = [tensor.requires_grad_() for tensor in tensors]
    gradient = torch.randn(rows, outputs)
    results = []
    for function in (linear, functional.linear):
        output = function(*tensors)
        results.append([output, *torch.autograd.grad(output, tensors, gradient)])
    torch.testing.assert_close(*results, atol=1e-4, rtol=1e-5)


@pytest.mark.parametrize("gradients", [True, False])
def test_the_relu_is_that_of_torch(gradients):
    torch.manual_seed(0)
    x = torch.randn(20, 8)
    weight = torch.randn(6, 8)
    bias = torch.randn(6)
    with torch.set_grad_enabled(gradients):
        output = linear(x, weight, bias, relu=True)
    torch.testing.assert_close(
        output,
        functional.linear(x, weight, bias).relu(),
        atol=1e-5,
        rtol=1e-5,
    )


def test_without_onednn_it_is_torchs_own(monkeypatch):
    torch.manual_seed(0)
    x, weight, bias = torch.randn(3, 4), torch.randn(5, 4), torch.randn(5)
    ordinary = functional.linear(x, weight, bias)
    monkeypatch.setattr(ganlane.linear, "ONEDNN", False)
    assert torch.equal(linear(x, weight, bias), ordinary)
    assert torch.equal(matrix_product(x, weight, bias, relu=True), ordinary.relu())
