"""The lean losses equal TorchRL's, the whole update autograd and Adam."""

from copy import deepcopy

import pytest
import torch
from agents_small import transitions
from torchrl.objectives import DistributionalDQNLoss, DQNLoss

from ganlane.agents import (
    NetworkConfig,
    QNetwork,
    Rainbow,
    RainbowConfig,
)
from ganlane.agents.loss import (
    LeanDistributionalLoss,
    LeanDQNLoss,
    UpdateGraph,
    project,
)
from ganlane.agents.network import redraw_noise
from ganlane.runtime import has_compiler

SIZE = 5


def batch(rows=64, scale=3.0):
    return transitions(SIZE, rows, scale=scale, most_steps=3)


def network(**options):
    torch.manual_seed(3)
    small = {
        "hidden": (16, 16),
        "atoms": 11,
        "v_min": -5.0,
        "v_max": 5.0,
    }
    return QNetwork(NetworkConfig(RainbowConfig(**{**small, **options}), SIZE))


def unlike_target(loss):
    """Make the target differ from the online network, so that mixing them up shows."""
    with torch.no_grad():
        for value in loss.target_network.parameters():
            value.add_(torch.randn_like(value), alpha=0.3)
    return loss


@pytest.mark.parametrize("rows", [64, 11])
@pytest.mark.parametrize("noisy", [True, False])
def test_the_distributional_loss_equals_torchrls(noisy, rows):
    """Also with as many rows as there are atoms, where a wrong shape would broadcast."""
    loss = unlike_target(
        LeanDistributionalLoss(network(noisy=noisy), gamma=0.97, kl_priority=False)
    )
    theirs = batch(rows=rows)
    ours = batch(rows=rows)
    parameters = list(loss.network.parameters())
    expected = DistributionalDQNLoss.forward(loss, theirs)["loss"]
    actual = loss(ours)["loss"]
    torch.testing.assert_close(actual, expected, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(ours["td_error"], theirs["td_error"], atol=1e-6, rtol=1e-6)
    gradients = [torch.autograd.grad(value.mean(), parameters) for value in (actual, expected)]
    torch.testing.assert_close(*gradients, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("double", [True, False])
def test_the_plain_loss_equals_torchrls(double):
    loss = unlike_target(LeanDQNLoss(network(distributional=False), gamma=0.97, double=double))
    theirs = batch()
    ours = batch()
    expected = DQNLoss.forward(loss, theirs)["loss"]
    torch.testing.assert_close(loss(ours)["loss"], expected, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(
        ours["td_error"] ** 2,
        theirs["td_error"],
        atol=1e-5,
        rtol=1e-5,
    )


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
    torch.testing.assert_close(
        projected,
        reference_projection(values, probabilities, support),
    )
    torch.testing.assert_close(projected[0], probabilities[0])
    torch.testing.assert_close(projected.sum(-1), torch.ones(20))


def test_the_loss_reports_the_share_of_the_returns_that_its_support_does_not_cover():
    loss = LeanDistributionalLoss(network(), gamma=1.0)
    data = batch()
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
    torch.testing.assert_close(
        data["td_error"].squeeze(-1),
        cross_entropy - entropy,
        atol=1e-5,
        rtol=1e-5,
    )
    assert (data["td_error"] >= 0).all()


@pytest.mark.parametrize("distributional", [True, False])
def test_every_parameter_gets_a_gradient_noise_included(
    distributional,
):
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
    """Where one next action alone is allowed, it counts as the best."""
    kind, options = (
        (LeanDistributionalLoss, {}) if distributional else (LeanDQNLoss, {"distributional": False})
    )
    loss = unlike_target(
        kind(
            network(noisy=False, dueling=False, **options),
            gamma=0.97,
            double=double,
        )
    )
    data = batch(scale=1.0)  # no target may lie wholly outside the support
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


# --- the whole update as one function


def agent(graph=None, masked=False, **options):
    usual = {
        "hidden": (16, 24),
        "atoms": 7,
        "batch_size": 32,
        "warmup": 100,
        "capacity": 1000,
        "target_period": 3,
    }
    config = RainbowConfig(**{**usual, "v_min": -20.0, "v_max": 20.0, **options})
    learner = Rainbow(config, SIZE, seed=0)
    data = batch(rows=600, scale=30.0)  # some targets lie outside the support
    if masked:
        data["next", "action_mask"] = (
            torch.rand(600, 3, generator=torch.Generator().manual_seed(1)) < 0.6
        )
        data["next", "action_mask"][:, 0] = True
    learner.store(data)
    if graph is not None:
        learner.graph = UpdateGraph(
            learner.network,
            learner.loss,
            learner.optimizer,
            config,
            compile=graph,
        )
    return learner


def assert_close(one, other):
    for (name, value), twin in zip(one.network.named_parameters(), other.network.parameters()):
        torch.testing.assert_close(value, twin, atol=2e-6, rtol=1e-5, msg=name)
    for mine, theirs in zip(one.optimizer.state.values(), other.optimizer.state.values()):
        for name in ("step", "exp_avg", "exp_avg_sq"):
            torch.testing.assert_close(
                mine[name],
                theirs[name],
                atol=1e-7,
                rtol=1e-3,
                msg=name,
            )


def run_both(graph, masked=False, updates=8, **options):
    plain = agent(masked=masked, **options)
    graphed = agent(graph, masked, **options)
    for _ in range(updates):
        expected = plain.update()
        actual = graphed.update()
        assert actual.keys() == expected.keys()
        for name, value in expected.items():
            torch.testing.assert_close(
                actual[name],
                value.detach(),
                atol=1e-5,
                rtol=1e-4,
                msg=name,
            )
    assert_close(plain, graphed)
    assert plain.updates == graphed.updates == updates
    return plain, graphed


@pytest.mark.parametrize(
    ("masked", "options"),
    [
        (False, {}),
        (True, {"gradient_clip": 0.01}),
        (
            True,
            {
                "learning_rate_end": 1e-5,
                "learning_rate_decisions": 100,
                "hidden": (8,),
            },
        ),
        (
            False,
            {"hidden": (8, 8, 8), "gamma": 0.9, "adam_eps": 1e-3},
        ),
    ],
)
def test_updates_are_those_of_the_loss_of_autograd_and_of_adam(masked, options):
    run_both(False, masked, **options)


def test_training_can_change_from_one_way_to_the_other_and_be_resumed():
    plain, graphed = run_both(False)
    resumed = agent(False)
    resumed.load_state_dict(deepcopy(plain.state_dict()))
    for learner in (plain, graphed, resumed):
        learner.update()
    assert_close(plain, graphed)
    assert_close(plain, resumed)
    back = agent()
    back.load_state_dict(deepcopy(graphed.state_dict()))
    back.update()
    plain.update()
    assert_close(plain, back)


@pytest.mark.parametrize(
    "part",
    [
        "distributional",
        "double",
        "dueling",
        "noisy",
        "prioritised",
        "kl_priority",
    ],
)
def test_an_agent_without_one_of_the_components_keeps_the_other_way(
    part,
):
    config = RainbowConfig(**{part: False})
    assert Rainbow(config, SIZE, compile=True).graph is None


@pytest.mark.slow
@pytest.mark.skipif(not has_compiler(), reason="no C++ compiler")
def test_the_compiled_graph_does_the_same():
    run_both(True, masked=True)
