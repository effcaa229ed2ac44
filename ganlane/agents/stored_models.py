"""Models of stable-baselines3 and plain networks from their files, without anybody's pickles.

``ganlane.sb3.driver(model).save("ppo")`` writes ``ppo.zip``, as ``model.save`` does, and beside it
``ppo.zip.json``: what the model reads, and the form of its network. From the archive only the
weights are read, which execute nothing. :func:`save_network` does so for a network of torch.
"""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from ganlane import keys
from ganlane.agents.drivers import ObservationPolicy, mask_in
from ganlane.agents.network import allowed_values
from ganlane.errors import ParameterError, UserError
from ganlane.files import PLACE, atomic_path, has_checksum, refuse_without_checksum, write_json
from ganlane.settings.actions import CONTROLS, ActionParameters
from ganlane.settings.observation import MaskParameters, ObservationConfig
from ganlane.settings.record import NotNegative, Number, Positive, Record, make, one_of, plain

Floats = npt.NDArray[np.float32]
#: Name of a network of :func:`save_network` among the algorithms.
_PLAIN = "MLP"
#: Algorithms whose MlpPolicy is rebuilt here, and the layers of the network that acts, by the
#: beginning of their names: hidden ones, and the last one.
NETWORKS: Mapping[str, tuple[str, str]] = {
    **dict.fromkeys(("PPO", "A2C", "MaskablePPO"), ("mlp_extractor.policy_net.", "action_net.")),
    "DQN": ("q_net.q_net.", ""),
    _PLAIN: ("", ""),
}
#: Models that come with the package.
SHIPPED_MODELS = ("agent_exit", "agent_human", "agent_merge")
#: What does not act: layers of critics and of target networks, and the spread of controls.
_OTHERS = ("mlp_extractor.value_net.", "value_net.", "q_net_target.", "log_std")
_ACTIVATIONS = ("Tanh", "ReLU", "ELU", "SiLU", "GELU")
#: Errors of archives and weights that are none.
_BROKEN = (OSError, KeyError, ValueError, RuntimeError, zipfile.BadZipFile, pickle.UnpicklingError)


@dataclass(frozen=True)
class Normaliser(Record):
    """The statistics of observations of a ``VecNormalize``, as a file has them.

    Attributes:
        mean, variance: of each number of the observation, [D].
        epsilon: is added to the variance.
        clip_obs: bound of what results.
    """

    mean: list[Number]
    variance: list[NotNegative]
    epsilon: NotNegative
    clip_obs: Positive

    def normalize_obs(self, observation: Floats) -> Floats:
        """What a ``VecNormalize`` makes of observations [N, D]."""
        mean = np.asarray(self.mean)
        deviation = np.sqrt(np.asarray(self.variance) + self.epsilon)
        scaled = (observation - mean) / deviation
        return np.clip(scaled, -self.clip_obs, self.clip_obs).astype(np.float32)


@dataclass(frozen=True)
class Network(Record):
    """The form of a model's network.

    Attributes:
        algorithm: its class.
        activation: torch's name of the function between the layers.
    """

    algorithm: Annotated[str, one_of(NETWORKS)]
    activation: Annotated[str, one_of(_ACTIVATIONS)]


@dataclass(frozen=True)
class Reading(Record):
    """What a model reads and commands, as the JSON beside its file says.

    Attributes:
        observation: what it observes.
        mask: which actions it may choose; None: it is not told.
        normaliser: of the observations; None: it reads them as they are.
        network: None: not one that can be rebuilt here.
        actions: what its outputs stand for.
    """

    observation: ObservationConfig = field(default_factory=ObservationConfig)
    mask: MaskParameters | None = None
    normaliser: Normaliser | None = None
    network: Network | None = None
    actions: ActionParameters = field(default_factory=ActionParameters)


class StoredModel(ObservationPolicy):
    """The deterministic policy of a stored model: writes ``action`` for ``observation`` [N, D].

    The action is the number [N] of the largest output, or outputs [N, 2] from -1 to 1.

    Args:
        layers: of the network that acts.
        reading: what it reads and commands.
    """

    def __init__(self, layers: nn.Sequential, reading: Reading) -> None:
        super().__init__()
        self.layers = layers
        self.normaliser = reading.normaliser
        self.is_masked = reading.mask is not None
        self.is_numbered = bool(reading.actions.names)
        self.in_keys = [keys.OBSERVATION]
        if self.is_masked:
            self.in_keys.append(keys.ACTION_MASK)

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """The largest output of every row, or the outputs.

        Raises:
            UserError: the observation has another size than the network's input, or the model is
                masked and the environment has no mask.
        """
        observation = tensordict.get(keys.OBSERVATION)
        expected = self.layers[0].in_features
        if observation.shape[-1] != expected:
            raise UserError(
                f"the model reads observations of {expected} numbers, but the environment gives "
                f"{observation.shape[-1]}; use the observation, vehicles and lanes of its training."
            )
        if self.normaliser is not None:
            # In NumPy, as VecNormalize does it.
            normalised = self.normaliser.normalize_obs(observation.cpu().numpy())
            observation = torch.from_numpy(normalised).to(observation.device)

        values = self.layers(observation)
        if not self.is_numbered:
            return values.clamp(-1.0, 1.0)
        if self.is_masked:
            values = allowed_values(values, mask_in(tensordict))
        return values.argmax(-1)


def description_of(file: Path) -> Path:
    """The JSON file beside that of a model."""
    return file.with_name(f"{file.name}.json")


def write_description(file: Path, reading: Reading) -> None:
    """The JSON file beside that of a model, whose checksum it holds."""
    content = {
        # Of this JSON file; filled in as it is written.
        "checksum": PLACE,
        "model_sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        "reads": plain(reading),
    }
    write_json(description_of(file), content)


def save_network(path: str | Path, layers: nn.Sequential, reading: Reading | None = None) -> None:
    """Store a network for ``ganlane benchmark PATH``.

    It acts by the largest of its outputs; where the actions are continuous, its outputs are they.

    Args:
        path: of the file, .zip; a JSON file is written beside it.
        layers: Linear layers with one kind of activation between them, say ``torchrl.modules.MLP``.
        reading: what it reads; None: the default observation, without a mask.

    Raises:
        UserError: another kind of network.
    """
    file = Path(path)
    # Every other layer is linear, the first and the last one among them.
    linear = list(layers)[::2]
    between = list(layers)[1::2]
    is_plain = len(linear) == len(between) + 1
    is_plain = is_plain and all(type(layer) is nn.Linear for layer in linear)
    # One kind of activation, of those that are known.
    kinds = {type(layer).__name__ for layer in between}
    is_plain = is_plain and len(kinds) == 1 and kinds <= {*_ACTIVATIONS}
    if file.suffix != ".zip" or not is_plain:
        raise UserError(
            f"{path}: expected a file .zip, and Linear layers with one of "
            f"{', '.join(_ACTIVATIONS)} between them."
        )

    # An archive as stable-baselines3 writes it, with the weights alone.
    weights = io.BytesIO()
    torch.save(layers.state_dict(), weights)
    with atomic_path(file) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("policy.pth", weights.getvalue())

    network = Network(_PLAIN, kinds.pop())
    write_description(file, replace(reading or Reading(), network=network))


def read_description(file: Path) -> Reading:
    """What stands in the JSON file beside a model.

    Raises:
        UserError: it is missing, damaged, or that of another model.
    """
    description = description_of(file)
    try:
        content = description.read_bytes()
        whole = has_checksum(content, description)
        described = json.loads(content)
        reading = make(Reading, described["reads"])
        digest = described["model_sha256"]
        is_same = digest == hashlib.sha256(file.read_bytes()).hexdigest()
    except (OSError, ValueError, KeyError, TypeError, RecursionError, ParameterError) as error:
        raise UserError(
            f"{description}: it does not say what the model reads ({error}); store the model with "
            "ganlane.sb3.driver(model).save(path), or load it with env=make_vec_env(...)."
        ) from error
    if not whole:
        refuse_without_checksum(description)
    if not is_same:
        raise UserError(
            f"{description}: it was written for another model than {file.name} is now; store the "
            "model with ganlane.sb3.driver(model).save(path)."
        )
    return reading


def load_model(file: Path, device: str = "cpu") -> tuple[StoredModel, Reading]:
    """The policy of a stored model, and what it reads.

    Args:
        file: the archive; its description lies beside it.
        device: of the policy.

    Raises:
        UserError: a missing or damaged file, or a network that is no plain MlpPolicy.
    """
    reading = read_description(file)
    network = reading.network
    if network is None:
        raise _not_plain(file)
    try:
        with zipfile.ZipFile(file) as archive:
            weights = io.BytesIO(archive.read("policy.pth"))
        # weights_only: tensors and nothing that could be executed.
        state = torch.load(weights, map_location=device, weights_only=True)
    except _BROKEN as error:
        raise UserError(
            f"{file}: no model of stable-baselines3 ({type(error).__name__}); give the file that "
            "ganlane.sb3.driver(model).save(path) wrote."
        ) from error

    # An output for each action, or for each control where the actions are not numbered.
    outputs = len(reading.actions.names) or CONTROLS
    layers = _layers(state, network, outputs)
    if layers is None:
        raise _not_plain(file)
    return StoredModel(layers.to(device), reading), reading


def _layers(state: Mapping[str, Any], network: Network, outputs: int) -> nn.Sequential | None:
    """The network that acts, of a model's weights; None where they are of another form.

    Args:
        state: the weights by name, of all that the model has.
        network: its form.
        outputs: how many it has to have.
    """
    # Hidden layers are numbered, with gaps for the activations between them.
    hidden, last = NETWORKS[network.algorithm]
    numbers = []
    for name in state:
        match = re.fullmatch(rf"{re.escape(hidden)}(\d+)\.weight", name)
        if match:
            numbers.append(int(match[1]))
    places = [f"{hidden}{number}." for number in sorted(numbers)]
    if last:
        places.append(last)

    # Weights that are neither expected nor known not to act are of another form.
    expected = {f"{place}{part}" for place in places for part in ("weight", "bias")}
    others = {name for name in state if name.startswith(_OTHERS)}
    if not places or expected | others != set(state):
        return None

    modules: list[nn.Module] = []
    for place in places:
        weight = state[f"{place}weight"]
        bias = state[f"{place}bias"]
        linear = nn.Linear(weight.shape[1], weight.shape[0])
        linear.load_state_dict({"weight": weight, "bias": bias})
        modules += [linear, getattr(nn, network.activation)()]
    if linear.out_features != outputs:
        return None
    # Nothing comes after the last layer.
    return nn.Sequential(*modules[:-1])


def _not_plain(file: Path) -> UserError:
    return UserError(
        f"{file}: its network is none that is rebuilt from weights ({', '.join(NETWORKS)} with "
        "MlpPolicy); drive it in Python, ganlane.benchmark(ganlane.sb3.driver(model))."
    )
