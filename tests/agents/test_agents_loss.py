"""The loss equals TorchRL's, the whole update autograd and Adam."""

from copy import deepcopy

import pytest
import torch
from agents_small import transitions
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import DistributionalQValueActor, QValueActor
from torchrl.objectives import DistributionalDQNLoss, DQNLoss

from ganlane.agents import (
    NetworkConfig,
    QNetwork,
    Rainbow,
    RainbowConfig,
)
from ganlane.agents.loss import UpdateGraph, bellman, loss_of, pick, project
from ganlane.agents.network import redraw_noise
from ganlane.runtime import has_compiler

SIZE = 5


def batch(rows=64, scale=3.0):
    return transitions(SIZE, rows, scale=scale, most_steps=3)


class Networks:
    """A network, and a target that differs from it, so that mixing them up shows."""

    def __init__(self, **options):
        torch.manual_seed(3)
        small = {
            "hidden": (16, 16),
            "atoms": 11,
            "v_min": -5.0,
            "v_max": 5.0,
            "gamma": 0.97,
        }
        self.config = RainbowConfig(**{**small, **options})
        self.online = QNetwork(NetworkConfig(self.config, SIZE))
        self.target = deepcopy(self.online).requires_grad_(False)
        for value in self.target.parameters():
            value.add_(torch.randn_like(value), alpha=0.3)

    def loss(self, data):
        """With noise, as an update has it."""
        with set_exploration_type(ExplorationType.RANDOM):
            return loss_of(self.online, self.target, data, self.config)

    def torchrls(self, data):
        """TorchRL's loss of the same two networks; it writes ``td_error`` into ``data``."""
        usual = {
            "delay_value": True,
            "reduction": "none",
            "use_prioritized_weights": False,
        }
        actor = actor_of(self.online)
        if self.config.distributional:
            loss = DistributionalDQNLoss(actor, gamma=0.97, **usual)
        else:
            usual |= {"double_dqn": self.config.double, "action_space": "categorical"}
            loss = DQNLoss(actor, loss_function="smooth_l1", **usual)
            loss.make_value_estimator(gamma=0.97)
        loss._has_update_associated["value_network"] = True
        target = TensorDict.from_module(actor_of(self.target))
        for name, value in loss.target_value_network_params.items(True, True):
            value.data.copy_(target[name].data)
        loss.deterministic_sampling_mode = ExplorationType.RANDOM
        return loss(data)["loss"]


class AsTorchRLWants(torch.nn.Module):
    """A network with log-probabilities [*, atoms, A] or values [*, A] as its output."""

    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, observation):
        if not self.network.config.agent.distributional:
            return self.network.values(observation)
        return self.network.logits(observation).log_softmax(-1).transpose(-1, -2)


def actor_of(network):
    usual = {"in_keys": ["observation"], "action_space": "categorical"}
    module = AsTorchRLWants(network)
    if not network.config.agent.distributional:
        return QValueActor(module, **usual)
    return DistributionalQValueActor(module, network.support, make_log_softmax=False, **usual)


@pytest.mark.parametrize("rows", [64, 11])
@pytest.mark.parametrize("noisy", [True, False])
def test_the_distributional_loss_equals_torchrls(noisy, rows):
    """Also with as many rows as there are atoms, where a wrong shape would broadcast."""
    networks = Networks(noisy=noisy, kl_priority=False)
    theirs = batch(rows=rows)
    parameters = list(networks.online.parameters())
    expected = networks.torchrls(theirs)
    actual = networks.loss(batch(rows=rows))
    torch.testing.assert_close(actual.loss, expected, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(actual.priority[:, None], theirs["td_error"], atol=1e-6, rtol=1e-6)
    gradients = [torch.autograd.grad(value.mean(), parameters) for value in (actual.loss, expected)]
    torch.testing.assert_close(*gradients, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("double", [True, False])
def test_the_plain_loss_equals_torchrls(double):
    networks = Networks(distributional=False, double=double)
    theirs = batch()
    expected = networks.torchrls(theirs)
    actual = networks.loss(batch())
    torch.testing.assert_close(actual.loss, expected, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(
        actual.priority[:, None] ** 2,
        theirs["td_error"],
        atol=1e-5,
        rtol=1e-5,
    )


def test_the_loss_reports_the_share_of_the_returns_that_its_support_does_not_cover():
    networks = Networks(gamma=1.0)
    data = batch()
    data["next", "terminated"][:] = True
    data["next", "reward"] = torch.linspace(-9.0, 9.0, 64)[:, None]
    beyond = (data["next", "reward"].abs() > 5.0).float().mean()
    torch.testing.assert_close(networks.loss(data).clamped_fraction, beyond)
    data["next", "reward"] *= 0.5
    assert networks.loss(data).clamped_fraction == 0.0


def test_the_kl_priority_is_the_cross_entropy_less_the_targets_entropy():
    networks = Networks(noisy=False)
    data = batch()
    terms = networks.loss(data)
    following = data["next", "observation"]
    best = networks.online.values(following).argmax(-1)
    support = networks.online.support
    probabilities = pick(networks.target.logits(following), best).softmax(-1)
    wanted, _ = project(bellman(data, 0.97, support), probabilities, support)
    entropy = -(wanted * wanted.clamp_min(1e-30).log()).sum(-1)
    torch.testing.assert_close(
        terms.priority,
        terms.loss.detach() - entropy,
        atol=1e-5,
        rtol=1e-5,
    )
    assert (terms.priority >= 0).all()


@pytest.mark.parametrize("distributional", [True, False])
def test_every_parameter_gets_a_gradient_noise_included(distributional):
    networks = Networks(distributional=distributional)
    redraw_noise(networks.online, torch.Generator().manual_seed(0))
    networks.loss(batch()).loss.mean().backward()
    assert all(value.grad.abs().sum() > 0 for value in networks.online.parameters())
    assert all(value.grad is None for value in networks.target.parameters())


@pytest.mark.parametrize("double", [True, False])
@pytest.mark.parametrize("distributional", [True, False])
def test_the_next_action_is_one_that_the_mask_allows(distributional, double):
    """Where one next action alone is allowed, it counts as the best."""
    networks = Networks(noisy=False, dueling=False, distributional=distributional, double=double)
    data = batch(scale=1.0)  # no target may lie wholly outside the support
    unmasked = networks.loss(data.clone()).loss
    only = torch.randint(0, 3, (64,), generator=torch.Generator().manual_seed(1))
    data["next", "action_mask"] = torch.nn.functional.one_hot(only, 3).bool()
    masked = networks.loss(data).loss
    choosing = networks.online if double else networks.target
    agree = choosing.values(data["next", "observation"]).argmax(-1) == only
    assert 5 < int(agree.sum()) < 59
    same = agree | data["next", "terminated"][:, 0]
    torch.testing.assert_close(masked[same], unmasked[same], atol=1e-6, rtol=1e-6)
    assert bool((masked[~same] != unmasked[~same]).all())


# --- the whole update as one function


def agent(graph=None, masked=False, **options):
    usual = {
        "hidden": (16, 24),
        "atoms": 7,
        "v_min": -20.0,
        "v_max": 20.0,
        "batch_size": 32,
        "warmup": 100,
        "capacity": 1000,
        "target_period": 3,
    }
    config = RainbowConfig(**{**usual, **options})
    learner = Rainbow(config, SIZE, seed=0)
    data = batch(rows=600, scale=30.0)  # some targets lie outside the support
    if masked:
        mask = torch.rand(600, 3, generator=torch.Generator().manual_seed(1)) < 0.6
        mask[:, 0] = True
        data["next", "action_mask"] = mask
    learner.store(data)
    if graph is not None:
        parts = (learner.network, learner.target, learner.optimizer, config)
        learner.graph = UpdateGraph(*parts, compile=graph)
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


@pytest.mark.parametrize(("before", "after"), [(0, False), (1, False), (1, None)])
def test_training_can_change_from_one_way_to_the_other_and_be_resumed(before, after):
    """From the plain way to the graph, within the graph, and from the graph to the plain way."""
    learners = run_both(False)
    resumed = agent(after)
    resumed.load_state_dict(deepcopy(learners[before].state_dict()))
    resumed.update()
    learners[0].update()
    assert_close(learners[0], resumed)


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
