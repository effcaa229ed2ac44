"""Layers of the networks: the linear layer, the LSTM, pooling."""

import pytest
import torch
from torch import nn

from ganlane.generator import layers as dense_module
from ganlane.generator.layers import (
    DIFFERENCE_SCALE_M,
    RANGE_M,
    MotionLSTM,
    PairPooling,
    apply,
    dense,
    gather_vehicles,
    motion_features,
    nearest,
)


@pytest.fixture
def scene():
    """Displacements [3, 13, 8, 2], positions and mask of a few padded groups."""
    torch.manual_seed(0)
    displacements = torch.tensor([1.3, 0.0]) + 0.05 * torch.randn(3, 13, 8, 2)
    position = torch.rand(3, 13, 2) * torch.tensor([80.0, 12.0])
    mask = torch.arange(13) < torch.tensor([[13], [7], [1]])
    return displacements, position, mask


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


def test_the_recurrence_is_torchs_own_lstm():
    torch.manual_seed(2)
    lstm = MotionLSTM(5, 7)
    reference = nn.LSTM(5, 7, batch_first=True)
    order = torch.arange(28).reshape(4, 7)[[0, 1, 3, 2]].flatten()  # torch's: input, forget, new, output
    with torch.no_grad():
        reference.weight_ih_l0.copy_(lstm.input.weight[order])
        reference.bias_ih_l0.copy_(lstm.input.bias[order])
        reference.weight_hh_l0.copy_(lstm.recurrent[order])
        reference.bias_hh_l0.zero_()
    displacement, difference = torch.randn(4, 6, 2), 0.05 * torch.randn(4, 6, 2)
    embedded = torch.relu(lstm.embed(motion_features(displacement, difference)))
    torch.testing.assert_close(lstm.encode(lstm.project(displacement, difference)), reference(embedded)[1][0][0])


def test_pooling_does_not_depend_on_the_order_of_vehicles(scene):
    _, position, mask = scene
    pooling = PairPooling(12, 10, 6, 8)
    hidden, motion, order = torch.randn(3, 13, 12), torch.randn(3, 13, 2), torch.randperm(13)
    pooled = pooling(hidden, position, motion, mask)
    shuffled = pooling(hidden[:, order], position[:, order], motion[:, order], mask[:, order])
    torch.testing.assert_close(shuffled, pooled[:, order])


@pytest.mark.parametrize("count", [9, 13])
def test_pooling_ignores_padding(scene, count):
    _, position, mask = (part[:, :count] for part in scene)
    pooling = PairPooling(12, 10, 6, 8)
    hidden, motion = torch.randn(3, count, 12), torch.randn(3, count, 2)
    pooled = pooling(hidden, position, motion, mask)
    noisy = torch.where(mask[..., None], hidden, 99.0), torch.where(mask[..., None], position, -3.0)
    torch.testing.assert_close(pooling(noisy[0], noisy[1], motion, mask)[mask], pooled[mask])
    torch.testing.assert_close(
        pooling(hidden[1:2, :7], position[1:2, :7], motion[1:2, :7], mask[1:2, :7]), pooled[1:2, :7]
    )


def test_a_vehicle_alone_pools_zeros(scene):
    _, position, mask = scene
    pooled = PairPooling(12, 10, 6, 8)(torch.randn(3, 13, 12), position, torch.randn(3, 13, 2), mask)
    assert (pooled[2, 0] == 0).all()
    assert (pooled[0] != 0).any()


def test_the_split_first_layer_equals_the_whole_one(scene):
    _, position, mask = scene
    pooling = PairPooling(12, 10, 6, 8)
    hidden, motion = torch.randn(3, 13, 12), torch.randn(3, 13, 2)
    index, seen = nearest(position, mask, 8)
    state = torch.cat([position / torch.tensor([20.0, 4.0]), motion / torch.tensor([0.4, 0.05])], dim=-1)
    pairs = gather_vehicles(state, index) - state[..., None, :]
    whole = nn.Linear(4 + 12, 10)
    with torch.no_grad():
        whole.weight.copy_(torch.cat([pooling.per_pair.weight, pooling.per_vehicle.weight], dim=1))
        whole.bias.copy_(pooling.per_pair.bias)
    first = torch.relu(whole(torch.cat([pairs, gather_vehicles(hidden, index)], dim=-1)))
    expected = torch.relu(pooling.second(first)).masked_fill(~seen[..., None], 0.0).amax(-2)
    torch.testing.assert_close(pooling(hidden, position, motion, mask), expected)


def test_the_nearest_are_found_as_by_sorting(scene):
    _, position, mask = scene
    index, seen = nearest(position, mask, 8)
    for row in range(3):
        for own in range(13):
            others = [j for j in range(13) if j != own and mask[row, j]]
            others.sort(key=lambda j: float((position[row, j] - position[row, own]).norm()))
            assert set(index[row, own][seen[row, own]].tolist()) == set(others[:8])


def test_a_few_vehicles_are_all_each_others_neighbours(scene):
    _, position, mask = (part[:, :9] for part in scene)
    index, seen = nearest(position, mask, 8)
    assert index is None
    assert (seen.sum(-1)[mask] <= mask.sum(-1, keepdim=True).expand_as(mask)[mask] - 1).all()
    assert seen[1, 0].tolist() == [False] + [True] * 6 + [False] * 2


def test_who_is_out_of_range_has_no_influence():
    position = torch.tensor([[[0.0, 0.0], [RANGE_M + 1.0, 0.0], [RANGE_M - 1.0, 0.0]]])
    _, seen = nearest(position, torch.ones(1, 3, dtype=torch.bool), 8)
    assert seen[0, 0].tolist() == [False, False, True]


def test_a_recorded_jump_is_cut_off_before_it_reaches_the_network():
    jump, cut = torch.tensor([1.5, 0.0]), torch.tensor([5.0 * DIFFERENCE_SCALE_M[0], 0.0])
    same = torch.zeros(2)
    torch.testing.assert_close(motion_features(same, jump), motion_features(same, cut))
