"""Dense layers give the same, whoever multiplies."""

import pytest
import torch
from torch import nn

from ganlane.generator import dense as dense_module
from ganlane.generator.dense import apply, dense


@pytest.mark.parametrize("relu", [False, True])
@pytest.mark.parametrize("shape", [(3, 5), (700, 5), (80, 9, 5)])
def test_it_is_a_linear_layer_for_few_rows_and_for_many(shape, relu):
    torch.manual_seed(0)
    layer, x = nn.Linear(5, 7), torch.randn(*shape)
    expected = layer(x).relu() if relu else layer(x)
    with torch.no_grad():
        torch.testing.assert_close(apply(layer, x, relu), expected)
        torch.testing.assert_close(dense(x, layer.weight), x @ layer.weight.T)
        torch.testing.assert_close(apply(layer.double(), x.double(), relu).float(), expected)


def test_with_gradients_it_has_them():
    layer = nn.Linear(5, 7)
    apply(layer, torch.randn(700, 5), relu=True).sum().backward()
    assert layer.weight.grad.abs().sum() > 0


@pytest.mark.skipif(not dense_module._ONEDNN, reason="this torch was built without oneDNN")
def test_many_rows_go_to_onednn(monkeypatch):
    seen = []
    monkeypatch.setattr(dense_module, "_onednn", lambda x, *rest: seen.append(len(x)))
    layer = nn.Linear(5, 7).requires_grad_(False)
    with torch.no_grad():
        apply(layer, torch.randn(700, 5))
        apply(layer, torch.randn(7, 5))
    apply(layer, torch.randn(700, 5))
    assert seen == [700]
