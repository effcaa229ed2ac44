"""The assembled agent.

Exploration, updates, switches, saving, and no touch of the global random state.
"""

import agents_small
import pytest
import torch
from agents_small import same_weights, transitions
from reference.refusals import user_error
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ganlane.agents import RainbowConfig

SIZE = 4


def agent(**options):
    return agents_small.agent(SIZE, **{"hidden": (16, 16), "v_min": -5.0, "v_max": 5.0, **options})


def filled(**options):
    result = agent(**options)
    result.store(transitions(SIZE))
    return result


def trained(updates=5, **options):
    result = filled(**options)
    for _ in range(updates):
        result.update()
    return result


def observations(rows=2000):
    generator = torch.Generator().manual_seed(9)
    return TensorDict({"observation": torch.randn(rows, SIZE, generator=generator)}, [rows])


# --- exploration


@pytest.mark.parametrize("kind", ["DETERMINISTIC", "MODE", "MEAN"])
def test_under_deterministic_exploration_the_policy_is_greedy_and_greedy_has_no_noise(kind):
    explorer = agent(noisy_sigma=3.0)
    data = observations()
    greedy = explorer.greedy(data.clone())["action"]
    explorer.policy(data.clone())  # leaves its noise in the network
    with set_exploration_type(ExplorationType[kind]):
        assert all(torch.equal(explorer.policy(data.clone())["action"], greedy) for _ in range(2))
    with set_exploration_type(ExplorationType.RANDOM):
        assert torch.equal(explorer.greedy(data.clone())["action"], greedy)


def test_the_policy_writes_the_action_and_what_it_thinks_it_worth():
    learner = agent()
    data = learner.policy(observations(3))
    assert set(learner.policy.out_keys) == {"action", "chosen_action_value"}
    assert set(data.keys()) == {"observation", "action", "chosen_action_value"}
    assert data["chosen_action_value"].shape == (3, 1)
    assert data["action"].dtype == torch.int64
    assert set(learner.greedy(observations(3)).keys()) == {"observation", "action"}


def test_a_share_epsilon_of_the_actions_is_random_and_legal():
    def legal(tensordict):
        mask = torch.ones(*tensordict.shape, 3, dtype=torch.bool)
        mask[:, 1] = False
        return mask

    explorer = agent(noisy=False, epsilon_start=0.5, legal=legal)
    explorer.network.head.bias.data[:] = 0.0
    greedy = explorer.greedy(observations())["action"]
    drawn = explorer.policy(observations())["action"]
    differing = drawn != greedy
    assert not (drawn[differing] == 1).any()
    assert 0.15 < differing.float().mean() < 0.5
    explorer.anneal(10**9)
    assert explorer.policy.epsilon == RainbowConfig().epsilon


def test_the_learning_rate_falls_in_a_straight_line_and_stays():
    falling = agent(learning_rate=1e-3, learning_rate_end=1e-4, learning_rate_decisions=100)
    rates = []
    for decisions in (0, 50, 100, 200):
        falling.anneal(decisions)
        rates.append(falling.optimizer.param_groups[0]["lr"])
    assert rates == pytest.approx([1e-3, 5.5e-4, 1e-4, 1e-4])


# --- updates


def test_the_target_is_copied_exactly_every_period():
    learner = filled(target_period=3)
    copied = []
    for _ in range(9):
        learner.update()
        pairs = zip(learner.network.parameters(), learner.target.parameters())
        copied.append(all(torch.equal(a, b) for a, b in pairs))
    assert copied == [False, False, True] * 3


def test_every_update_draws_the_noise_of_both_networks_anew():
    learner = filled()
    modules = (learner.network, learner.target)
    before = [module.head.weight_epsilon.clone() for module in modules]
    learner.update()
    after = [module.head.weight_epsilon for module in modules]
    assert not any(torch.equal(a, b) for a, b in zip(before, after))
    assert not torch.equal(*after)


def test_an_update_gives_the_drawn_items_their_new_priority_and_metrics_without_dimensions():
    learner = filled()
    before = learner.replay.sampler.priorities.clone()
    metrics = learner.update()
    assert not torch.equal(before, learner.replay.sampler.priorities)
    assert set(metrics) == {"loss", "mean_q", "clamped_fraction", "priority", "gradient_norm"}
    assert all(value.shape == () and not value.requires_grad for value in metrics.values())


SWITCHES = ["noisy", "dueling", "distributional", "double", "prioritised"]


@pytest.mark.parametrize("off", [[name] for name in SWITCHES] + [SWITCHES])
def test_each_component_can_be_switched_off_and_the_rest_learns(off):
    slowly = {"learning_rate": 3e-3, "target_period": 1000, "noisy_sigma": 0.1}
    learner = filled(**dict.fromkeys(off, False), **slowly)
    before = learner.loss(transitions(SIZE))["loss"].mean()
    for _ in range(80):
        learner.update()
    assert learner.loss(transitions(SIZE))["loss"].mean() < 0.95 * before


def test_the_agent_learns_the_values_of_a_known_chain():
    """Two states, the reward of the second is its action.

    Worth gamma^0 * 2 at best, and the first gamma * 2.
    """
    learner = agent(learning_rate=3e-3, target_period=20, gamma=0.5, n_step=1, noisy=False)
    data = transitions(SIZE, 300)
    state = torch.arange(300) % 2
    one_hot = torch.eye(SIZE)
    data["observation"] = one_hot[state]
    data["next", "observation"] = one_hot[1].expand(300, SIZE)
    data["next", "reward"] = (state * data["action"]).float()[:, None]
    data["next", "terminated"] = (state == 1)[:, None]
    learner.store(data)
    for _ in range(300):
        learner.update()
    expected = torch.tensor([[1.0, 1.0, 1.0], [0.0, 1.0, 2.0]])
    values = learner.network.values(one_hot[:2])
    torch.testing.assert_close(values, expected, atol=0.15, rtol=0.0)


# --- randomness and saving


def test_the_seed_decides_everything_and_the_global_random_state_is_left_alone():
    torch.manual_seed(1)
    before = torch.get_rng_state()
    first = trained()
    first.policy(observations(5))
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(2)
    assert same_weights(first, trained())
    assert not same_weights(first, trained(seed=1))


@pytest.mark.parametrize("options", [{}, dict.fromkeys(SWITCHES, False)], ids=["all", "none"])
def test_a_restored_agent_goes_on_to_the_same_weights(options, tmp_path):
    whole = trained(6, **options)
    torch.save(trained(3, **options).state_dict(), tmp_path / "agent.pt")
    restored = agent(seed=77, **options)
    restored.load_state_dict(torch.load(tmp_path / "agent.pt", weights_only=True))
    for _ in range(3):
        restored.update()
    assert same_weights(restored, whole)
    actions = [learner.policy(observations())["action"] for learner in (restored, whole)]
    assert torch.equal(*actions)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"v_min": 9.0}, "^v_min="),
        ({"warmup": 1}, "^warmup="),
        ({"learning_rate_end": 1e-4}, "give both or neither"),
        ({"learning_rate_decisions": 100}, "give both or neither"),
    ],
)
def test_hyperparameters_that_do_not_fit_together_are_refused(options, told):
    with user_error(told):
        agent(**options)


def test_the_state_of_an_agent_with_another_option_is_refused():
    with user_error(r"agent.kl_priority=False: the saved agent has True"):
        agent(kl_priority=False).load_state_dict(agent().state_dict())
