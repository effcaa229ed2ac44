"""The permutation-invariant encoder: the order of the vehicles is nothing to it, and it learns with the rest."""

import pytest
import torch
from agents_transitions import transitions
from tensordict import TensorDict
from torchrl.objectives import DistributionalDQNLoss

from ganlane.agents import Rainbow, RainbowConfig, load_agent, save_agent, transfer
from ganlane.agents.encoder import VehicleEncoder
from ganlane.agents.loss import LeanDistributionalLoss
from ganlane.agents.network import NetworkConfig, QNetwork
from ganlane.errors import UserError

#: Table III for 9 vehicles, without and with the own lane change.
SIZES = [27, 29]
SMALL = {"hidden": (16, 16), "batch_size": 32, "warmup": 32, "capacity": 500, "v_min": -5.0, "v_max": 5.0}


def network(size=29, **options):
    torch.manual_seed(0)
    given = {"hidden": (16, 16), "atoms": 11, "encoder": "shared", "encoder_width": 8, "encoder_layers": 2, **options}
    return QNetwork(NetworkConfig(size, 3, **given))


def shuffled(observation, order):
    """The same scene with its vehicles in another order."""
    listed = observation[:, 3:27].unflatten(1, (8, 3))[:, order].flatten(1)
    return torch.cat((observation[:, :3], listed, observation[:, 27:]), dim=1)


def agent(size=29, seed=0, **options):
    return Rainbow(RainbowConfig(**{**SMALL, "encoder": "shared", "encoder_width": 8, **options}), size, seed=seed)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("layers", [1, 2])
def test_the_order_of_the_vehicles_does_not_matter(size, layers):
    encoded, plain = network(size, encoder_layers=layers), network(size, encoder="none")
    observation = torch.randn(20, size)
    other = shuffled(observation, torch.tensor([3, 0, 7, 1, 2, 6, 5, 4]))
    torch.testing.assert_close(encoded.values(other), encoded.values(observation))
    assert not torch.allclose(plain.values(other), plain.values(observation))


@pytest.mark.parametrize("size", SIZES)
def test_every_number_of_the_observation_is_read(size):
    observation = torch.randn(200, size, requires_grad=True)
    network(size).values(observation).square().sum().backward()
    assert (observation.grad.abs().sum(0) > 0).all()


def test_the_summary_is_the_largest_answer_of_the_vehicles_taken_one_by_one():
    encoder = VehicleEncoder(29, width=8, layers=1)
    observation = torch.randn(5, 29)
    own = torch.cat((observation[:, :3], observation[:, 27:]), dim=1)
    (layer,) = encoder.layers
    answers = [layer(torch.cat((observation[:, i : i + 3], own), dim=1)).relu() for i in range(3, 27, 3)]
    expected = torch.cat((own, torch.stack(answers).amax(0)), dim=1)
    torch.testing.assert_close(encoder(observation), expected)
    assert encoder.outputs == expected.shape[1]


def test_any_number_of_leading_dimensions_is_encoded():
    encoder, observation = VehicleEncoder(27, width=8), torch.randn(2, 5, 27)
    torch.testing.assert_close(encoder(observation)[1], encoder(observation[1]))
    torch.testing.assert_close(encoder(observation)[1, 3], encoder(observation[1, 3]))


@pytest.mark.parametrize("distributional", [True, False])
def test_gradients_reach_every_parameter_of_the_encoder(distributional):
    learner = agent(distributional=distributional, encoder_layers=2)
    before = learner.weights()
    learner.store(transitions(29))
    for _ in range(5):
        learner.update()
    after = learner.weights()
    assert sum(name.startswith("encoder.") for name in before) == 4
    assert [name for name in before if torch.equal(before[name], after[name])] == []


def test_the_loss_with_an_encoder_equals_torchrls():
    loss = LeanDistributionalLoss(network(v_min=-5.0, v_max=5.0), gamma=0.97, kl_priority=False)
    with torch.no_grad():
        for value in loss.target_network.parameters():
            value.add_(torch.randn_like(value), alpha=0.3)
    parameters = list(loss.network.parameters())
    data = transitions(29)
    data["next", "done"] = data["next", "terminated"]
    theirs = DistributionalDQNLoss.forward(loss, data.clone())["loss"]
    ours = loss(data.clone())["loss"]
    torch.testing.assert_close(ours, theirs, atol=1e-6, rtol=1e-6)
    expected, actual = (torch.autograd.grad(value.mean(), parameters) for value in (theirs, ours))
    torch.testing.assert_close(actual, expected, atol=1e-6, rtol=1e-5)


def test_an_agent_with_an_encoder_is_rebuilt_from_its_file(tmp_path):
    saved, path = agent(), tmp_path / "agent.safetensors"
    save_agent(path, saved, {"observation": "table3_progress"})
    data = TensorDict({"observation": torch.randn(100, 29)}, [100])
    policy, metadata = load_agent(path, observation_size=29)
    assert torch.equal(policy(data.clone())["action"], saved.greedy(data.clone())["action"])
    assert metadata["network"]["encoder"] == "shared"
    fresh = agent(seed=3)
    transfer(fresh, path)
    assert torch.equal(fresh.greedy(data.clone())["action"], saved.greedy(data.clone())["action"])
    with pytest.raises(UserError, match=r"agent.encoder=shared"):
        transfer(agent(encoder="none"), path)


def test_an_agent_saved_before_there_were_encoders_has_none(tmp_path, monkeypatch):
    plain, path = agent(encoder="none"), tmp_path / "agent.safetensors"
    whole = {**vars(plain.network.config)}
    old = {name: value for name, value in whole.items() if not name.startswith("encoder")}
    monkeypatch.setattr("ganlane.agents.checkpoint.asdict", lambda config: old)
    save_agent(path, plain, {})
    policy, metadata = load_agent(path)
    assert "encoder" not in metadata["network"]
    assert policy.network.encoder is None


def test_without_an_encoder_the_network_is_the_one_it_was():
    names = {name.split(".")[0] for name, _ in network(encoder="none").named_parameters()}
    assert names == {"trunk", "head"}


def test_a_restored_agent_goes_on_to_the_same_weights():
    whole, half = agent(), agent()
    for learner, updates in ((whole, 6), (half, 3)):
        learner.store(transitions(29))
        for _ in range(updates):
            learner.update()
    restored = agent(seed=7)
    restored.load_state_dict(half.state_dict())
    for _ in range(3):
        restored.update()
    pairs = zip(restored.weights().values(), whole.weights().values())
    assert all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("size", [3, 5, 25, 28])
def test_an_observation_of_another_layout_is_refused(size):
    with pytest.raises(UserError, match=f"observations of {size} numbers are not laid out as in Table III"):
        network(size)


def test_an_unknown_encoder_is_refused():
    with pytest.raises(UserError, match="choose one of none, shared"):
        network(encoder="lstm")
    with pytest.raises(UserError, match="encoder=lstm: expected one of none, shared"):
        agent(encoder="lstm")
    with pytest.raises(UserError, match=r"^encoder_width=0: expected at least 1"):
        RainbowConfig(encoder_width=0)
