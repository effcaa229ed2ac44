"""The lean losses equal TorchRL's, and the projection an independent reference."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import DistributionalDQNLoss, DQNLoss

from ganlane.agents.loss import LeanDistributionalLoss, LeanDQNLoss, project
from ganlane.agents.network import NetworkConfig, QNetwork, redraw_noise

SIZE = 5


def batch(seed=0, rows=64, scale=3.0):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(shape, generator=generator)

    return TensorDict(
        {
            "observation": normal(rows, SIZE),
            "action": torch.randint(0, 3, (rows,), generator=generator),
            "steps_to_next_obs": torch.randint(1, 4, (rows, 1), generator=generator).float(),
            "next": {
                "observation": normal(rows, SIZE),
                "reward": scale * normal(rows, 1),
                "terminated": torch.rand(rows, 1, generator=generator) < 0.3,
                "done": torch.rand(rows, 1, generator=generator) < 0.3,
            },
        },
        batch_size=[rows],
    )


def network(**options):
    torch.manual_seed(3)
    given = {"hidden": (16, 16), "atoms": 11, "v_min": -5.0, "v_max": 5.0, **options}
    return QNetwork(NetworkConfig(SIZE, 3, **given))


def unlike_target(loss):
    """Make the target differ from the online network, so that mixing them up shows."""
    with torch.no_grad():
        for value in loss.target_network.parameters():
            value.add_(torch.randn_like(value), alpha=0.3)
    return loss


@pytest.mark.parametrize("rows", [64, 11])
@pytest.mark.parametrize("noisy", [True, False])
def test_the_distributional_loss_equals_torchrls(noisy, rows):
    """Also when the batch has as many rows as there are atoms, where a wrong shape would broadcast."""
    loss = unlike_target(LeanDistributionalLoss(network(noisy=noisy), gamma=0.97, kl_priority=False))
    data = batch(rows=rows)
    theirs, ours = data.clone(), data.clone()
    expected = DistributionalDQNLoss.forward(loss, theirs)["loss"]
    actual = loss(ours)["loss"]
    torch.testing.assert_close(actual, expected, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(ours["td_error"], theirs["td_error"], atol=1e-6, rtol=1e-6)


def test_its_gradients_equal_torchrls():
    loss = unlike_target(LeanDistributionalLoss(network(), gamma=0.97))
    parameters = list(loss.network.parameters())
    expected = torch.autograd.grad(DistributionalDQNLoss.forward(loss, batch())["loss"].mean(), parameters)
    actual = torch.autograd.grad(loss(batch())["loss"].mean(), parameters)
    torch.testing.assert_close(actual, expected, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("double", [True, False])
def test_the_plain_loss_equals_torchrls(double):
    loss = unlike_target(LeanDQNLoss(network(distributional=False), gamma=0.97, double=double))
    theirs, ours = batch(), batch()
    expected = DQNLoss.forward(loss, theirs)["loss"]
    torch.testing.assert_close(loss(ours)["loss"], expected, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(ours["td_error"] ** 2, theirs["td_error"], atol=1e-5, rtol=1e-5)


def test_without_double_the_target_network_chooses():
    single = unlike_target(LeanDistributionalLoss(network(noisy=False), gamma=0.97, double=False))
    data = batch()
    values = single.target_network.values(data["next", "observation"])
    assert torch.isclose(single(data)["mean_q"], values.amax(-1).mean())
    double = LeanDistributionalLoss(single.network, gamma=0.97, double=True)
    assert not torch.isclose(double(data)["mean_q"], values.amax(-1).mean())


def reference_projection(values, probabilities, support):
    """Bellemare et al. 2017, equation 7, atom by atom."""
    step = float(support[1] - support[0])
    projected = torch.zeros_like(probabilities)
    for row in range(values.shape[0]):
        for value, mass in zip(values[row].tolist(), probabilities[row].tolist()):
            held = min(max(value, float(support[0])), float(support[-1]))
            for i, atom in enumerate(support.tolist()):
                projected[row, i] += mass * min(max(1.0 - abs(held - atom) / step, 0.0), 1.0)
    return projected


def test_the_projection_is_that_of_the_paper():
    torch.manual_seed(0)
    support = torch.linspace(-2, 2, 9)
    values = torch.randn(20, 9) * 3
    values[0] = support  # exactly on the atoms: nothing may vanish
    probabilities = torch.randn(20, 9).softmax(-1)
    projected = project(values, probabilities, support)
    torch.testing.assert_close(projected, reference_projection(values, probabilities, support))
    torch.testing.assert_close(projected[0], probabilities[0])
    torch.testing.assert_close(projected.sum(-1), torch.ones(20))


def test_the_loss_reports_the_share_of_the_returns_that_its_support_does_not_cover():
    loss, data = LeanDistributionalLoss(network(), gamma=1.0), batch()
    data["next", "terminated"][:] = True
    data["next", "reward"] = torch.linspace(-9.0, 9.0, 64)[:, None]
    beyond = (data["next", "reward"].abs() > 5.0).float().mean()
    torch.testing.assert_close(loss(data)["clamped_fraction"], beyond)
    data["next", "reward"] *= 0.5
    assert loss(data)["clamped_fraction"] == 0.0


def test_the_kl_priority_is_the_cross_entropy_less_the_targets_entropy():
    loss = unlike_target(LeanDistributionalLoss(network(noisy=False), gamma=0.97))
    data = batch()
    cross_entropy = loss(data)["loss"].detach()
    target = loss._target(data, loss.network.weights())[0].detach()
    entropy = -(target * target.clamp_min(1e-30).log()).sum(-1)
    torch.testing.assert_close(data["td_error"].squeeze(-1), cross_entropy - entropy, atol=1e-5, rtol=1e-5)
    assert (data["td_error"] >= 0).all()


@pytest.mark.parametrize("distributional", [True, False])
def test_every_parameter_gets_a_gradient_noise_included(distributional):
    net = network(distributional=distributional)
    loss = (LeanDistributionalLoss if distributional else LeanDQNLoss)(net, gamma=0.97)
    redraw_noise(net, torch.Generator().manual_seed(0))
    loss(batch())["loss"].mean().backward()
    for name, value in net.named_parameters():
        assert value.grad is not None, name
        assert value.grad.abs().sum() > 0, name
    assert all(value.grad is None for value in loss.target_network.parameters())


def test_the_target_network_is_torchrls_target_parameters():
    """So that TorchRL's own updaters and forward see the same target as the lean forward."""
    loss = LeanDistributionalLoss(network(), gamma=0.97)
    pointers = {value.data_ptr() for value in loss.target_network.parameters()}
    theirs = {value.data_ptr() for value in loss.target_value_network_params.values(True, True)}
    assert pointers <= theirs


@pytest.mark.parametrize("double", [True, False])
@pytest.mark.parametrize("distributional", [True, False])
def test_the_next_action_is_one_that_the_mask_allows(distributional, double):
    """Where one next action alone is allowed, the target is that of a network to which it is the best."""
    kind, options = (LeanDistributionalLoss, {}) if distributional else (LeanDQNLoss, {"distributional": False})
    loss = unlike_target(kind(network(noisy=False, dueling=False, **options), gamma=0.97, double=double))
    data = batch()
    only = torch.randint(0, 3, (64,), generator=torch.Generator().manual_seed(1))
    data["next", "action_mask"] = torch.nn.functional.one_hot(only, 3).bool()
    masked = loss(data.clone())["loss"]
    choosing = loss.network if double else loss.target_network
    best = choosing.values(data["next", "observation"]).argmax(-1)
    agree = best == only
    unmasked = loss(data.exclude(("next", "action_mask")).clone())["loss"]
    assert 5 < int(agree.sum()) < 59
    torch.testing.assert_close(masked[agree], unmasked[agree], atol=1e-6, rtol=1e-6)
    ended = data["next", "terminated"][:, 0]
    torch.testing.assert_close(masked[ended], unmasked[ended], atol=1e-6, rtol=1e-6)
    assert bool((masked[~agree & ~ended] != unmasked[~agree & ~ended]).all())
