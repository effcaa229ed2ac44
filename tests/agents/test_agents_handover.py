"""From a trained agent to one that starts from it."""

import pytest
import torch
from agents_small import agent, saved_in

from ganlane.agents import save_agent, transfer
from ganlane.agents.handover import load_moments
from ganlane.errors import UserError


@pytest.fixture
def saved(tmp_path):
    return saved_in(tmp_path)


def test_another_support_is_refused_on_transfer_naming_both_ways_out(saved):
    with pytest.raises(UserError, match=r"here: agent.v_min=-10\).*init.support=trained, set agent.v_min=-120,"):
        transfer(agent(v_min=-10.0), saved)


def test_another_network_is_refused_without_hope_for_its_support(saved):
    with pytest.raises(UserError, match=r"set agent.hidden=\[8,8\] agent.atoms=101, or start") as refused:
        transfer(agent(hidden=(8,), atoms=51), saved)
    assert "init.support" not in str(refused.value)


def test_without_a_distribution_the_support_means_nothing(tmp_path):
    path, plain = tmp_path / "agent.safetensors", {"distributional": False}
    save_agent(path, agent(**plain), {})
    transfer(agent(seed=1, v_min=-10.0, atoms=51, **plain), path)


def test_a_transfer_starts_from_the_saved_weights(saved):
    fresh = agent(seed=3)
    assert transfer(fresh, saved)["training"] == {"decisions": 7}
    assert all(torch.equal(a, b) for a, b in zip(fresh.weights().values(), agent().weights().values()))


def descend(learner, seed):
    """One step of its optimiser along a random gradient."""
    generator = torch.Generator().manual_seed(seed)
    for value in learner.network.parameters():
        value.grad = torch.randn(value.shape, generator=generator)
    learner.optimizer.step()


def weights_differ(one, other):
    return not all(torch.equal(a, b) for a, b in zip(one.weights().values(), other.weights().values()))


def test_adam_goes_on_from_the_moments_that_it_is_given():
    trained, warm, cold = agent(), agent(seed=1), agent(seed=2)
    for seed in (1, 2, 3):
        descend(trained, seed)
    for fresh in (warm, cold):
        fresh.load_weights(trained.weights())
    moments = trained.optimizer.state_dict()["state"]
    load_moments(warm, moments)
    for learner in (trained, warm, cold):  # in this order: the two must not share what they change
        descend(learner, 4)
    assert not weights_differ(trained, warm)
    assert weights_differ(trained, cold)
    descend(trained, 5)
    descend(warm, 5)
    assert not weights_differ(trained, warm)


def test_only_moments_are_taken_over_the_rate_is_ones_own():
    trained, fresh = agent(learning_rate=1e-2, adam_eps=1e-3), agent(learning_rate=1e-4, adam_eps=1e-8)
    descend(trained, 1)
    load_moments(fresh, trained.optimizer.state_dict()["state"])
    (group,) = fresh.optimizer.param_groups
    assert (group["lr"], group["eps"]) == (1e-4, 1e-8)


def test_moments_kept_in_half_precision_come_back_as_floats():
    trained, fresh = agent(), agent()
    descend(trained, 1)
    load_moments(fresh, trained.state_dict(with_replay=False)["optimizer"]["state"])
    for value, state in fresh.optimizer.state.items():
        assert state["exp_avg"].dtype == value.dtype
        assert state["exp_avg_sq"].dtype == value.dtype
    exact, rounded = (learner.optimizer.state_dict()["state"] for learner in (trained, fresh))
    for row in exact:
        torch.testing.assert_close(rounded[row]["exp_avg"], exact[row]["exp_avg"], rtol=2**-8, atol=0.0)


@pytest.mark.parametrize("damage", ["absent", "fewer", "another shape", "no step", "text"])
def test_moments_of_another_network_are_refused(damage):
    trained = agent()
    descend(trained, 1)
    moments = {row: dict(state) for row, state in trained.optimizer.state_dict()["state"].items()}
    if damage == "absent":
        del moments[0]
    elif damage == "fewer":
        del moments[1]["exp_avg_sq"]
    elif damage == "another shape":
        moments[0]["exp_avg"] = moments[0]["exp_avg"][:1]
    elif damage == "no step":
        del moments[0]["step"]
    else:
        moments[0] = "moments"
    fresh = agent()
    with pytest.raises(UserError, match="not those of its network"):
        load_moments(fresh, moments)
    assert fresh.optimizer.state_dict()["state"] == {}
