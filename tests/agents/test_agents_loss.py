"""The lean losses equal TorchRL's, the whole update autograd and Adam."""

from copy import deepcopy

import agents_small
import pytest
import torch
from agents_small import transitions
from torchrl.objectives import DistributionalDQNLoss, DQNLoss

from ganlane.agents import NetworkConfig, QNetwork, Rainbow, RainbowConfig
from ganlane.agents.loss import (
    LeanDistributionalLoss,
    LeanDQNLoss,
    UpdateGraph,
    bellman,
    pick,
    project,
    update,
)
from ganlane.agents.network import duel, redraw_noise
from ganlane.runtime import has_compiler

SIZE = 5


def batch(rows=64, scale=3.0):
    return transitions(SIZE, rows, scale=scale, most_steps=3)


def network(**options):
    torch.manual_seed(3)
    small = {"hidden": (16, 16), "atoms": 11, "v_min": -5.0, "v_max": 5.0, "gamma": 0.97}
    return QNetwork(NetworkConfig(RainbowConfig(**{**small, **options}), SIZE))


def unlike_target(loss):
    """Make the target differ from the online network, so that mixing them up shows."""
    with torch.no_grad():
        for value in loss.target_network.parameters():
            value.add_(torch.randn_like(value), alpha=0.3)
    return loss


def assert_same_loss(loss, theirs, rows, power=1):
    """That a loss gives TorchRL's figures and gradients; TorchRL's error may be a ``power`` of
    ours.
    """
    data, twin = batch(rows=rows), batch(rows=rows)
    values = [loss(data)["loss"], theirs.forward(loss, twin)["loss"]]
    errors = [data["td_error"] ** power, twin["td_error"]]
    parameters = list(loss.network.parameters())
    gradients = [torch.autograd.grad(value.mean(), parameters) for value in values]
    for ours, expected in (values, errors, gradients):
        torch.testing.assert_close(ours, expected, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("rows", [64, 11])
@pytest.mark.parametrize("noisy", [True, False])
def test_the_distributional_loss_equals_torchrls(noisy, rows):
    """Also with as many rows as there are atoms, where a wrong shape would broadcast."""
    loss = unlike_target(LeanDistributionalLoss(network(noisy=noisy, kl_priority=False)))
    assert_same_loss(loss, DistributionalDQNLoss, rows)


@pytest.mark.parametrize("double", [True, False])
def test_the_plain_loss_equals_torchrls(double):
    loss = unlike_target(LeanDQNLoss(network(distributional=False, double=double)))
    assert_same_loss(loss, DQNLoss, 64, power=2)


def test_the_loss_reports_the_share_of_the_returns_that_its_support_does_not_cover():
    loss = LeanDistributionalLoss(network(gamma=1.0))
    data = batch()
    data["next", "terminated"][:] = True
    data["next", "reward"] = torch.linspace(-9.0, 9.0, 64)[:, None]
    beyond = (data["next", "reward"].abs() > 5.0).float().mean()
    torch.testing.assert_close(loss(data)["clamped_fraction"], beyond)
    data["next", "reward"] *= 0.5
    assert loss(data)["clamped_fraction"] == 0.0


def test_the_kl_priority_is_the_cross_entropy_less_the_targets_entropy():
    loss = unlike_target(LeanDistributionalLoss(network(noisy=False)))
    data = batch()
    cross_entropy = loss(data)["loss"].detach()
    following = data["next", "observation"]
    best = loss.network.values(following).argmax(-1)
    support = loss.network.support
    probabilities = pick(loss.target_network.logits(following), best).softmax(-1)
    wanted, _ = project(bellman(data, 0.97, support), probabilities, support)
    entropy = -(wanted * wanted.clamp_min(1e-30).log()).sum(-1)
    priority = data["td_error"].squeeze(-1)
    torch.testing.assert_close(priority, cross_entropy - entropy, atol=1e-5, rtol=1e-5)
    assert (data["td_error"] >= 0).all()


def test_dueling_takes_the_mean_advantage_off():
    rows = torch.tensor([[10.0], [1.0], [2.0], [6.0]])
    assert duel(rows).flatten().tolist() == [8.0, 9.0, 13.0]


@pytest.mark.parametrize("distributional", [True, False])
def test_every_parameter_gets_a_gradient_noise_included(distributional):
    net = network(distributional=distributional)
    loss = (LeanDistributionalLoss if distributional else LeanDQNLoss)(net)
    redraw_noise(net, torch.Generator().manual_seed(0))
    loss(batch())["loss"].mean().backward()
    assert all(value.grad.abs().sum() > 0 for value in net.parameters())
    assert all(value.grad is None for value in loss.target_network.parameters())


@pytest.mark.parametrize("double", [True, False])
@pytest.mark.parametrize("kind", [LeanDistributionalLoss, LeanDQNLoss])
def test_the_next_action_is_one_that_the_mask_allows(kind, double):
    """Where one next action alone is allowed, it counts as the best."""
    distributional = kind is LeanDistributionalLoss
    net = network(noisy=False, dueling=False, distributional=distributional, double=double)
    loss = unlike_target(kind(net))
    data = batch(scale=1.0)  # no target may lie wholly outside the support
    unmasked = loss(data.clone())["loss"]
    only = torch.arange(64) % 3
    data["next", "action_mask"] = only[:, None] == torch.arange(3)
    masked = loss(data)["loss"]
    choosing = loss.network if double else loss.target_network
    agree = choosing.values(data["next", "observation"]).argmax(-1) == only
    assert 5 < int(agree.sum()) < 59
    same = agree | data["next", "terminated"][:, 0]
    torch.testing.assert_close(masked[same], unmasked[same], atol=1e-6, rtol=1e-6)
    assert bool((masked[~same] != unmasked[~same]).all())


# --- the whole update as one function


USUAL = {"hidden": (16, 24), "atoms": 7, "v_min": -20.0, "v_max": 20.0, "target_period": 3}


def agent(graph=None, masked=False, **options):
    learner = agents_small.agent(SIZE, capacity=1000, **{**USUAL, **options})
    data = batch(rows=600, scale=30.0)  # some targets lie outside the support
    if masked:
        mask = torch.rand(600, 3, generator=torch.Generator().manual_seed(1)) < 0.6
        mask[:, 0] = True
        data["next", "action_mask"] = mask
    learner.store(data)
    if graph is not None:
        parts = (learner.network, learner.target, learner.optimizer, learner.config)
        learner.graph = UpdateGraph(*parts)
        if not graph:
            learner.graph.update = update
    return learner


def assert_close(one, other):
    for value, twin in zip(one.network.parameters(), other.network.parameters()):
        torch.testing.assert_close(value, twin, atol=2e-6, rtol=1e-5)
    for mine, theirs in zip(one.optimizer.state.values(), other.optimizer.state.values()):
        torch.testing.assert_close(mine, theirs, atol=1e-7, rtol=1e-3)


def run_both(graph, masked=False, updates=8, **options):
    plain = agent(masked=masked, **options)
    graphed = agent(graph, masked, **options)
    for _ in range(updates):
        expected = {name: value.detach() for name, value in plain.update().items()}
        torch.testing.assert_close(graphed.update(), expected, atol=1e-5, rtol=1e-4)
    assert_close(plain, graphed)
    assert plain.updates == graphed.updates == updates
    return plain, graphed


@pytest.mark.parametrize(
    ("masked", "options"),
    [
        (False, {}),
        (True, {"gradient_clip": 0.01}),
        (True, {"learning_rate_end": 1e-5, "learning_rate_decisions": 100, "hidden": (8,)}),
        (False, {"hidden": (8, 8, 8), "gamma": 0.9, "adam_eps": 1e-3}),
    ],
)
def test_updates_are_those_of_the_loss_of_autograd_and_of_adam(masked, options):
    run_both(False, masked, **options)


@pytest.mark.parametrize(("before", "after"), [(0, False), (1, False), (1, None)])
def test_training_can_change_from_one_way_to_the_other_and_be_resumed(before, after):
    """From the plain way to the graph, within the graph, and from the graph to the plain way."""
    learners = run_both(False)
    resumed = agent(after)
    resumed.load_state_dict(deepcopy(learners[before].state_dict()))
    resumed.update()
    learners[0].update()
    assert_close(learners[0], resumed)


PARTS = ["distributional", "double", "dueling", "noisy", "prioritised", "kl_priority"]


@pytest.mark.parametrize("part", PARTS)
def test_an_agent_without_one_of_the_components_keeps_the_other_way(part):
    assert Rainbow(RainbowConfig(**{part: False}), SIZE, compile=True).graph is None


@pytest.mark.slow
@pytest.mark.skipif(not has_compiler(), reason="no C++ compiler")
def test_the_compiled_graph_does_the_same():
    run_both(True, masked=True)
