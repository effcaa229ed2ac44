"""The networks and their layers."""

import pytest
import torch
from reference.small_networks import silenced, small_generator
from torch import nn

from ganlane.generator import networks
from ganlane.generator.closed_loop import push, recorded


@pytest.fixture
def scene():
    """Displacements [3, 13, 8, 2], positions and mask of a few padded groups."""
    torch.manual_seed(0)
    displacements = torch.tensor([1.3, 0.0]) + 0.05 * torch.randn(3, 13, 8, 2)
    position = torch.rand(3, 13, 2) * torch.tensor([80.0, 12.0])
    mask = torch.arange(13) < torch.tensor([[13], [7], [1]])
    return displacements, position, mask


@pytest.fixture
def pooled(scene):
    """A pooling and its arguments: hidden states [3, 13, 12], positions, displacements and mask."""
    _, position, mask = scene
    return networks.PairPooling(12, 10, 6, 8), (
        torch.randn(3, 13, 12),
        position,
        torch.randn(3, 13, 2),
        mask,
    )


@pytest.fixture
def generator():
    return small_generator(seed=1)


@pytest.mark.parametrize("shape", [(3, 5), (80, 9, 5)])
def test_it_is_a_linear_layer_for_few_rows_and_for_many(shape):
    torch.manual_seed(0)
    layer = nn.Linear(5, 7)
    x = torch.randn(*shape)
    with torch.no_grad():
        torch.testing.assert_close(networks.apply(layer, x, relu=True), layer(x).relu())
        torch.testing.assert_close(networks.dense(x, layer.weight), x @ layer.weight.T)


def test_the_recurrence_is_torchs_own_lstm():
    torch.manual_seed(2)
    lstm = networks.MotionLSTM(5, 7)
    reference = nn.LSTM(5, 7, batch_first=True)
    # torch's: input, forget, new, output
    order = torch.arange(28).reshape(4, 7)[[0, 1, 3, 2]].flatten()
    weights = {
        "weight_ih_l0": lstm.input.weight[order],
        "bias_ih_l0": lstm.input.bias[order],
        "weight_hh_l0": lstm.recurrent[order],
        "bias_hh_l0": torch.zeros(28),
    }
    reference.load_state_dict(weights)
    displacement = torch.randn(4, 6, 2)
    difference = 0.05 * torch.randn(4, 6, 2)
    embedded = torch.relu(lstm.embed(networks.motion_features(displacement, difference)))
    torch.testing.assert_close(
        lstm.encode(lstm.project(displacement, difference).unbind(1)), reference(embedded)[1][0][0]
    )


def test_pooling_does_not_depend_on_the_order_of_vehicles(pooled):
    pooling, arguments = pooled
    order = torch.randperm(13)
    shuffled = pooling(*(part[:, order] for part in arguments))
    torch.testing.assert_close(shuffled, pooling(*arguments)[:, order])


@pytest.mark.parametrize("count", [9, 13])
def test_pooling_ignores_padding(pooled, count):
    pooling, whole = pooled
    padded = pooling(*(part[:, :count] for part in whole))
    # Seven vehicles are real in this row.
    alone = pooling(*(part[1:2, :7] for part in whole))
    torch.testing.assert_close(alone, padded[1:2, :7])


def test_the_nearest_in_range_are_found_as_by_sorting(scene):
    _, position, mask = scene
    # Some are out of range.
    position *= torch.tensor([2.5, 1.0])
    index, seen = networks.nearest(position, mask, 8)
    for row in range(3):
        for vehicle in range(13):
            offset = position[row] - position[row, vehicle]
            in_range = mask[row] & (offset[:, 0].abs() < networks.RANGE_M)
            others = [j for j in range(13) if j != vehicle and in_range[j]]
            others.sort(key=lambda j: float(offset[j].norm()))
            assert set(index[row, vehicle][seen[row, vehicle]].tolist()) == set(others[:8])


def test_with_a_head_of_zeros_the_prediction_is_constant_velocity(scene, generator):
    displacements = scene[0]
    predicted = silenced(generator)(generator.observe(*scene), torch.randn(3, 13, 4))
    torch.testing.assert_close(predicted, displacements[..., -1:, :].expand_as(predicted))


def test_kept_projections_equal_those_computed_anew(generator):
    displacements = torch.tensor([1.3, 0.0]) + 0.05 * torch.randn(2, 4, 20, 2)
    history = recorded(generator, displacements[..., :7, :])
    for step in range(7, 20):
        history, _ = push(generator, history, displacements[..., step, :])
        anew = generator.encoder.project_course(displacements[..., step - 7 : step + 1, :])
        torch.testing.assert_close(history.motions, anew)


def test_gradient_reaches_every_parameter_of_the_discriminator(scene):
    displacements, _, mask = scene
    discriminator = networks.Discriminator(16, 12)
    discriminator(displacements)[mask].sum().backward()
    for name, parameter in discriminator.named_parameters():
        assert parameter.grad.abs().sum() > 0, name
