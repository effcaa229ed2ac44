"""A stored model is its weights and a description; nothing else of the archive is read."""

import hashlib
import io
import zipfile
from pathlib import Path

import pytest
import torch
from reference.refusals import Bomb, user_error
from tensordict import TensorDict

from ganlane import keys
from ganlane.agents.stored_models import Reading, load_model, save_network
from ganlane.build import make_driver
from ganlane.files import PLACE, write_json
from ganlane.settings.env import EnvConfig
from ganlane.settings.observation import MaskParameters

SIZE = 4
pytestmark = pytest.mark.usefixtures("empty_folder")


def weights(hidden="mlp_extractor.policy_net.", last="action_net."):
    """A network that acts by the number of the observation that is largest."""
    return {
        f"{hidden}0.weight": torch.eye(SIZE),
        f"{hidden}0.bias": torch.zeros(SIZE),
        f"{last}weight": torch.eye(3, SIZE),
        f"{last}bias": torch.zeros(3),
        "value_net.weight": torch.ones(1, SIZE),
    }


def store(state, algorithm="PPO", mask=None, **changes):
    """A file as driver(model).save() writes it, with whatever else in the archive."""
    file = Path("ppo.zip")
    content = io.BytesIO()
    torch.save(state, content)
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("policy.pth", content.getvalue())
        archive.writestr("data", "never read")
    network = {"algorithm": algorithm, "activation": "ReLU"}
    reads = {"observation": "lane_view", "mask": mask, "normaliser": None, "network": network}
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    described = {"checksum": PLACE, "model_sha256": digest, "reads": {**reads, **changes}}
    write_json(Path("ppo.zip.json"), described)
    return file


def actions_of(policy, observation, mask=None):
    rows = {keys.OBSERVATION: torch.tensor(observation)}
    if mask is not None:
        rows[keys.ACTION_MASK] = torch.tensor(mask)
    return policy(TensorDict(rows, [len(observation)]))[keys.ACTION].tolist()


def test_the_action_is_that_of_the_largest_output():
    policy, reading = load_model(store(weights()))
    assert actions_of(policy, [[0.0, 2.0, 1.0, 9.0], [3.0, 2.0, 1.0, 9.0]]) == [1, 0]
    assert reading.observation.form == "lane_view"


def test_a_value_network_is_read_as_well():
    state = weights("q_net.q_net.", "q_net.q_net.2.")
    policy, _ = load_model(store({**state, "q_net_target.q_net.0.bias": torch.ones(1)}, "DQN"))
    del state["value_net.weight"]
    assert actions_of(policy, [[0.0, 0.0, 1.0, 9.0]]) == [2]


def test_a_model_with_masks_chooses_among_the_allowed_actions():
    policy, reading = load_model(store(weights(), "MaskablePPO", mask={"form": "safe"}))
    assert actions_of(policy, [[0.0, 2.0, 1.0, 9.0]], [[True, False, True]]) == [2]
    assert reading.mask.form == "safe"


def test_controls_are_the_outputs_themselves_within_their_bounds():
    state = {**weights(), "log_std": torch.zeros(2)}
    state["action_net.weight"], state["action_net.bias"] = torch.eye(2, SIZE), torch.zeros(2)
    policy, _ = load_model(store(state, actions={"form": "continuous"}))
    assert actions_of(policy, [[0.5, 2.0, 1.0, 9.0]]) == [[0.5, 1.0]]


@pytest.mark.parametrize(
    "changes",
    [
        {"network": None},
        {"network": {"algorithm": "TRPO", "activation": "ReLU"}},
        {"network": {"algorithm": "PPO", "activation": "Module"}},
    ],
)
def test_another_network_is_refused_in_one_sentence(changes):
    with user_error("ppo.zip"):
        make_driver(str(store(weights(), **changes)), EnvConfig())


def test_weights_of_another_form_are_refused():
    state = {**weights(), "features_extractor.cnn.0.weight": torch.ones(1)}
    with user_error("none that is rebuilt from weights"):
        load_model(store(state))


def test_nothing_in_the_weights_is_executed():
    with user_error("no model of stable-baselines3"):
        load_model(store({"mlp_extractor.policy_net.0.weight": Bomb()}))
    assert not Path("executed").exists()


def test_the_description_is_bound_to_the_file():
    file = store(weights())
    file.write_bytes(file.read_bytes() + b" ")
    with user_error("for another model than ppo.zip is now"):
        load_model(file)
    text = Path("ppo.zip.json").read_text()
    for damaged in (
        text.replace("lane_view", "table3"),
        text.replace("ganlane sha256", "nothing"),
        text[:50],
        "[" * 100_000,
        "3",
    ):
        Path("ppo.zip.json").write_text(damaged)
        with user_error("ppo.zip.json: "):
            load_model(file)


def network(*between, last=None):
    """Linear layers with others between them."""
    layers = [torch.nn.Linear(SIZE, SIZE)]
    for layer in between:
        layers += [layer, torch.nn.Linear(SIZE, SIZE)]
    return torch.nn.Sequential(*layers, *([] if last is None else [last]))


def test_a_plain_network_is_stored_and_acts_as_before():
    layers = torch.nn.Sequential(*network(torch.nn.Tanh())[:2], torch.nn.Linear(SIZE, 3))
    save_network("mlp.zip", layers, Reading(mask=MaskParameters("safe")))
    driver = make_driver("mlp.zip", EnvConfig())
    assert driver.mask == MaskParameters("safe")
    observation = torch.randn(50, SIZE, generator=torch.Generator().manual_seed(0))
    for mask in ([True, True, True], [True, False, True]):
        best = layers(observation).where(torch.tensor(mask), -torch.inf).argmax(-1)
        assert actions_of(driver.policy, observation.tolist(), [mask] * 50) == best.tolist()


@pytest.mark.parametrize(
    ("path", "layers"),
    [
        ("mlp.pt", network(torch.nn.Tanh())),
        ("mlp.zip", network(torch.nn.Tanh(), torch.nn.ReLU())),
        ("mlp.zip", network(torch.nn.Softplus())),
        ("mlp.zip", network(torch.nn.Tanh(), last=torch.nn.Tanh())),
        ("mlp.zip", torch.nn.Sequential(torch.nn.LayerNorm(SIZE), torch.nn.Tanh(), *network())),
    ],
)
def test_a_network_of_another_kind_is_not_stored(path, layers):
    with user_error("expected a file .zip, and Linear layers with one of Tanh, ReLU"):
        save_network(path, layers)
    assert not list(Path().iterdir())
