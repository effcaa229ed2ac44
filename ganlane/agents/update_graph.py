"""One update of Rainbow as one function, its backward pass written out, to be compiled to one graph.

What :meth:`ganlane.agents.rainbow.Rainbow.update` does with TorchRL's loss, autograd, ``clip_grad_norm_`` and Adam,
here without any of them, for the agent with all six components: the loss is the cross-entropy of the projected target
(Bellemare et al. 2017, equation 7), double, with importance weights; noise is part of the weights; the duel is folded
into the head, since ``Q_a = V + A_a - mean(A)`` is linear in its weights. Equal to the other way up to rounding
(tests/agents/test_agents_update_graph.py), and faster on a CPU (docs/performance.md).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.agents.loss import LeanDistributionalLoss, outside_support, pick, project
from ganlane.agents.network import QNetwork, matrix_product, noise_of
from ganlane.agents.policy import allowed_values
from ganlane.parameters.agent import RainbowConfig
from ganlane.torch_settings import compiled

#: ``weight_mu, weight_sigma, bias_mu, bias_sigma`` of a noisy layer.
_PARAMETERS = ("weight_mu", "weight_sigma", "bias_mu", "bias_sigma")
_BETA_1, _BETA_2 = 0.9, 0.999


class Batch(NamedTuple):
    """Transitions: ``observation`` and ``following`` [B, D], ``allowed`` [B, A] bool (following), the rest [B]."""

    observation: Tensor
    action: Tensor
    reward: Tensor
    following: Tensor
    alive: Tensor
    steps: Tensor
    weight: Tensor
    allowed: Tensor


class Learned(NamedTuple):
    """``priority`` [B]; 0-dim: the weighted ``loss``, ``mean_q``, ``clamped_fraction``, ``gradient_norm``."""

    priority: Tensor
    loss: Tensor
    mean_q: Tensor
    clamped_fraction: Tensor
    gradient_norm: Tensor


class Settings(NamedTuple):
    """What does not change during a training."""

    actions: int
    atoms: int
    gamma: float
    gradient_clip: float
    adam_eps: float


def composed(parameters: Sequence[Tensor], noise: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Weight [O, I] and bias [O] of a noisy layer (Fortunato et al. 2017); ``noise`` of its inputs and outputs."""
    weight_mu, weight_sigma, bias_mu, bias_sigma = parameters
    inputs, outputs = noise
    return weight_mu + weight_sigma * torch.outer(outputs, inputs), bias_mu + bias_sigma * outputs


def folded(weight: Tensor, bias: Tensor, actions: int) -> tuple[Tensor, Tensor]:
    """The head [(1 + A) K, H] with the duel in its weights, [A K, H]."""
    made = []
    for each in (weight, bias):
        rows = each.unflatten(0, (1 + actions, -1))
        made.append((rows[:1] + rows[1:] - rows[1:].mean(0, keepdim=True)).flatten(0, 1))
    return made[0], made[1]


def unfolded(gradient: Tensor, actions: int) -> Tensor:
    """Gradient of the head from that of the folded head: the transpose of :func:`folded`."""
    rows = gradient.unflatten(0, (actions, -1))
    return torch.cat((rows.sum(0, keepdim=True), rows - rows.mean(0, keepdim=True))).flatten(0, 1)


def forward(layers: Sequence[tuple[Tensor, Tensor]], x: Tensor) -> list[Tensor]:
    """The input of every layer, and the output of the last."""
    inputs = [x]
    for number, (weight, bias) in enumerate(layers):
        inputs.append(matrix_product(inputs[-1], weight, bias, relu=number < len(layers) - 1))
    return inputs


def gradients(
    layers: Sequence[tuple[Tensor, Tensor]],
    noise: Sequence[Sequence[Tensor]],
    inputs: Sequence[Tensor],
    of_logits: Tensor,
) -> list[Tensor]:
    """Of all parameters, in the layers' order, from that of the folded head's output [B, A K]."""
    found: list[Tensor] = []
    behind = of_logits
    for number in reversed(range(len(layers))):
        of_weight, of_bias = matrix_product(behind.t(), inputs[number].t()), behind.sum(0)
        if number == len(layers) - 1:
            actions = len(of_bias) // (len(noise[number][1]) - len(of_bias))
            of_weight, of_bias = unfolded(of_weight, actions), unfolded(of_bias, actions)
        drawn_in, drawn_out = noise[number]
        found = [of_weight, of_weight * torch.outer(drawn_out, drawn_in), of_bias, of_bias * drawn_out, *found]
        if number:
            behind = torch.where(inputs[number] > 0, matrix_product(behind, layers[number][0].t()), 0.0)
    return found


def update(
    settings: Settings,
    support: Tensor,
    online: list[Tensor],
    target: list[Tensor],
    mean: list[Tensor],
    square: list[Tensor],
    noise: Sequence[Sequence[Tensor]],
    target_noise: Sequence[Sequence[Tensor]],
    batch: Batch,
    rate: Tensor,
    corrections: Tensor,
) -> Learned:
    """Change ``online`` and Adam's moments ``mean`` and ``square`` in place by one step on ``batch``.

    Args:
        settings: fixed numbers.
        support: of the distribution, [K].
        online, target: parameters, four per layer.
        noise, target_noise: of each layer's inputs and outputs.
        rate: learning rate, 0-dim.
        corrections: of Adam's two moments for their start at zero, [2].
    """
    actions, atoms = settings.actions, settings.atoms
    networks = []
    for parameters, drawn in ((online, noise), (target, target_noise)):
        layers = [composed(parameters[4 * i : 4 * i + 4], drawn[i]) for i in range(len(drawn))]
        layers[-1] = folded(*layers[-1], actions)
        networks.append(layers)
    layers, target_layers = networks
    rows = len(batch.action)
    inputs = forward(layers, torch.cat((batch.observation, batch.following)))
    logits = inputs.pop().unflatten(-1, (actions, atoms))
    best, chosen = allowed_values(logits[rows:].softmax(-1) @ support, batch.allowed).max(-1)
    target_logits = forward(target_layers, batch.following)[-1].unflatten(-1, (actions, atoms))
    probabilities = pick(target_logits, chosen).softmax(-1)
    discount = torch.pow(settings.gamma, batch.steps)
    values = batch.reward[:, None] + (batch.alive * discount)[:, None] * support
    wanted = project(values, probabilities, support)
    log_p = pick(logits[:rows], batch.action).log_softmax(-1)
    loss = -(wanted * log_p).sum(-1)
    priority = (loss - torch.special.entr(wanted).sum(-1)).clamp_min(0.0)

    of_chosen = (log_p.exp() * wanted.sum(-1, keepdim=True) - wanted) * (batch.weight / rows)[:, None]
    is_chosen = batch.action[:, None] == torch.arange(actions, device=support.device)
    of_logits = torch.where(is_chosen[..., None], of_chosen[:, None, :], 0.0).flatten(1)
    found = gradients(layers, noise, [each[:rows] for each in inputs], of_logits)
    norm = torch.stack([(each * each).sum() for each in found]).sum().sqrt()
    scale = (settings.gradient_clip / (norm + 1e-6)).clamp_max(1.0)
    for parameter, gradient, first, second in zip(online, found, mean, square):
        clipped = gradient * scale
        first.lerp_(clipped, 1.0 - _BETA_1)
        second.mul_(_BETA_2).addcmul_(clipped, clipped, value=1.0 - _BETA_2)
        step = first * corrections[0] / ((second * corrections[1]).sqrt() + settings.adam_eps)
        parameter.sub_(rate * step)
    return Learned(
        priority, (batch.weight * loss).mean(), best.mean(), outside_support(values, probabilities, support), norm
    )


def can_graph(config: RainbowConfig, device: torch.device) -> bool:
    """Whether :func:`update` does what ``config`` says: Rainbow's network and loss whole, on a CPU."""
    parts = (config.distributional, config.double, config.dueling, config.noisy, config.prioritised)
    return all(parts) and device.type == "cpu"


class UpdateGraph:
    """The compiled update of an agent: works on the tensors of its networks and of its optimiser.

    Args:
        network, loss, optimizer, config: the agent's.
        compile: False: the same function, eager.
    """

    def __init__(
        self,
        network: QNetwork,
        loss: LeanDistributionalLoss,
        optimizer: torch.optim.Adam,
        config: RainbowConfig,
        compile: bool = True,
    ) -> None:
        self.network, self.target, self.optimizer = network, loss.target_network, optimizer
        own, eps = network.config, optimizer.param_groups[0]["eps"]
        self.settings = Settings(own.actions, own.atoms, config.gamma, config.gradient_clip, eps)
        self._update: Callable[..., Learned] = compiled(update) if compile else update

    def __call__(self, batch: TensorDictBase, generator: torch.Generator) -> Learned:
        """One update on ``batch`` (keys as in :class:`LeanDistributionalLoss`); noise from ``generator``."""
        online, target = _parameters(self.network), _parameters(self.target)
        moments = [self._moments(parameter) for parameter in online]
        torch._foreach_add_([each["step"] for each in moments], 1.0)
        step, (group,) = float(moments[0]["step"]), self.optimizer.param_groups
        corrections = torch.tensor([1.0 / (1.0 - _BETA_1**step), 1.0 / (1.0 - _BETA_2**step)])
        noise, target_noise = (noise_of(network, generator) for network in (self.network, self.target))
        following, action = batch.get("next"), batch.get("action")
        allowed = following.get(keys.ACTION_MASK, None)
        given = Batch(
            batch.get("observation"),
            action,
            following.get("reward")[:, 0],
            following.get("observation"),
            (~following.get("terminated")[:, 0]).float(),
            batch.get("steps_to_next_obs")[:, 0].float(),
            batch.get("priority_weight"),
            torch.ones((len(action), self.settings.actions), dtype=torch.bool) if allowed is None else allowed,
        )
        rate = torch.tensor(float(group["lr"]))
        mean, square = ([each[name] for each in moments] for name in ("exp_avg", "exp_avg_sq"))
        with torch.no_grad():
            return self._update(
                self.settings, self.network.support, [value.detach() for value in online],
                [value.detach() for value in target], mean, square, noise, target_noise, given, rate, corrections,
            )  # fmt: skip

    def _moments(self, parameter: Tensor) -> dict[str, Any]:
        """Adam's state of a parameter, made as Adam makes it at its first step."""
        state = self.optimizer.state[parameter]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        return state


def _parameters(network: QNetwork) -> list[Tensor]:
    return [getattr(layer, name) for layer in (*network.trunk, network.head) for name in _PARAMETERS]
