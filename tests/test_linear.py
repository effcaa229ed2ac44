"""The fast linear layer is the ordinary one."""

import pytest
import torch
from torch.nn import functional

import ganlane.linear
from ganlane.linear import linear, matrix_product


@pytest.mark.parametrize("relu", [False, True])
@pytest.mark.parametrize(("rows", "inputs", "outputs"), [(1, 1, 1), (7, 29, 13), (256, 64, 51)])
def test_values_and_gradients_are_those_of_torch(rows, inputs, outputs, relu):
    torch.manual_seed(0)
    shapes = ((rows, inputs), (outputs, inputs), (outputs,))
    tensors = [torch.randn(shape, requires_grad=True) for shape in shapes]
    gradient = torch.randn(rows, outputs)
    theirs = functional.linear(*tensors)
    theirs = theirs.relu() if relu else theirs
    ours = linear(*tensors, relu=relu)
    with torch.no_grad():
        alone = linear(*tensors, relu=relu)
    close = {"atol": 1e-4, "rtol": 1e-5}
    torch.testing.assert_close([ours, alone], [theirs, theirs], **close)
    of_ours, of_theirs = (torch.autograd.grad(y, tensors, gradient) for y in (ours, theirs))
    torch.testing.assert_close(of_ours, of_theirs, **close)


def test_without_onednn_it_is_torchs_own(monkeypatch):
    torch.manual_seed(0)
    x, weight, bias = torch.randn(3, 4), torch.randn(5, 4), torch.randn(5)
    ordinary = functional.linear(x, weight, bias)
    monkeypatch.setattr(ganlane.linear, "ONEDNN", False)
    assert torch.equal(linear(x, weight, bias), ordinary)
    assert torch.equal(matrix_product(x, weight, bias, relu=True), ordinary.relu())
