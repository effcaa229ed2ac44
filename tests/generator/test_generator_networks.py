import pytest
import torch
from torch import nn

from ganlane.generator.closed_loop import push, recorded, start
from ganlane.generator.networks import Discriminator, Generator
from ganlane.parameters.generator import GeneratorSizes

SIZES = GeneratorSizes(embedding=16, hidden=12, pooling=10, pooled=6, context=14, noise=4)


@pytest.fixture
def scene():
    """Displacements [3, 13, 8, 2], positions and mask of a few padded groups."""
    torch.manual_seed(0)
    displacements = torch.tensor([1.3, 0.0]) + 0.05 * torch.randn(3, 13, 8, 2)
    position = torch.rand(3, 13, 2) * torch.tensor([80.0, 12.0])
    mask = torch.arange(13) < torch.tensor([[13], [7], [1]])
    return displacements, position, mask


@pytest.fixture
def generator():
    torch.manual_seed(1)
    return Generator(SIZES)


def test_with_a_head_of_zeros_the_prediction_is_constant_velocity(scene, generator):
    nn.init.zeros_(generator.head.weight)
    nn.init.zeros_(generator.head.bias)
    displacements, position, mask = scene
    predicted = generator(generator.observe(displacements, position, mask), torch.randn(3, 13, 4))
    torch.testing.assert_close(predicted, displacements[..., -1:, :].expand_as(predicted))


@pytest.mark.parametrize("execute_k", [1, 3, 8])
def test_the_first_k_decoder_steps_are_those_of_the_whole(scene, generator, execute_k):
    displacements, position, mask = scene
    seen, noise = generator.observe(displacements, position, mask), torch.randn(3, 13, 4)
    torch.testing.assert_close(generator(seen, noise, execute_k), generator(seen, noise)[..., :execute_k, :])


def test_samples_share_one_context(scene, generator):
    displacements, position, mask = scene
    seen, noise = generator.observe(displacements, position, mask), torch.randn(5, 3, 13, 4)
    together = generator(seen, noise)
    torch.testing.assert_close(together[3], generator(seen, noise[3]))


def test_kept_projections_equal_those_computed_anew(generator):
    displacements = torch.tensor([1.3, 0.0]) + 0.05 * torch.randn(2, 4, 20, 2)
    history = recorded(generator, displacements[..., :7, :])
    for step in range(7, 20):
        history, difference = push(generator, history, displacements[..., step, :])
        anew = generator.project(displacements[..., step - 7 : step + 1, :])
        torch.testing.assert_close(history.projections, anew)
        torch.testing.assert_close(difference, displacements[..., step, :] - displacements[..., step - 1, :])


def test_a_fresh_history_is_that_of_constant_velocity(generator):
    displacement = torch.tensor([[[1.7, 0.0], [0.9, 0.0]]])
    always = displacement[..., None, :].expand(1, 2, 8, 2)
    torch.testing.assert_close(start(generator, displacement).projections, generator.project(always))


def test_gradient_reaches_every_parameter_of_both_networks(scene, generator):
    displacements, position, mask = scene
    discriminator = Discriminator(16, 12)
    predicted = generator(generator.observe(displacements, position, mask), torch.randn(3, 13, 4))
    discriminator(torch.cat([displacements, predicted], dim=-2))[mask].sum().backward()
    for module in (generator, discriminator):
        for name, parameter in module.named_parameters():
            assert parameter.grad is not None, name
            assert parameter.grad.abs().sum() > 0, name


def test_the_discriminator_can_say_both(scene):
    logits = Discriminator(16, 12)(torch.randn(200, 16, 2))
    assert logits.shape == (200,)
    assert logits.min() < logits.max()
