"""The losses, from TorchRL's, and a whole update of Rainbow as one compiled function.

:class:`LeanDistributionalLoss` equals :class:`torchrl.objectives.DistributionalDQNLoss` (Bellemare
et al. 2017, double) to 1e-6 and takes half of its time, by a lean forward on plain tensors;
:class:`LeanDQNLoss` does the same for the plain DQN loss. Both keep TorchRL's parameter containers,
so a TorchRL user finds ``value_network_params`` and the target where expected.

:func:`update` is what :meth:`ganlane.agents.rainbow.Rainbow.update` does with the first of them,
autograd, ``clip_grad_norm_`` and Adam, here without any of these, for the agent with all six
components: noise is part of the weights, the backward pass is written out, and the duel is folded
into the head, since ``Q_a = V + A_a - mean(A)`` is linear in its weights. :class:`UpdateGraph`
compiles it to one graph. Equal to the other way up to rounding (tests/agents/test_agents_loss.py),
and faster on a CPU (docs/speed.md).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn.functional import smooth_l1_loss
from torchrl.envs.utils import ExplorationType
from torchrl.modules import DistributionalQValueActor, QValueActor
from torchrl.objectives import DistributionalDQNLoss, DQNLoss

from ganlane import keys
from ganlane.agents.network import (
    QNetwork,
    Weights,
    allowed_values,
    load_parameters,
    noise_of,
    parameters_of,
)
from ganlane.linear import matrix_product
from ganlane.settings.agent import RainbowConfig
from ganlane.torch_settings import compiled

#: Parameters of a noisy layer.
_PARAMETERS = ("weight_mu", "weight_sigma", "bias_mu", "bias_sigma")
#: Of TorchRL's losses.
_OPTIONS: dict[str, Any] = {
    "delay_value": True,
    "reduction": "none",
    "use_prioritized_weights": False,
}
# Adam's usual decay rates, of the first and of the second moment.
_BETA_1 = 0.9
_BETA_2 = 0.999


class _OfRainbow:
    """What is ours in both losses: a second module with the loss's target parameters, whose noise
    can be drawn anew, and a forward pass on plain tensors, with a mask of the next actions.
    """

    network: QNetwork
    target_network: QNetwork
    config: RainbowConfig

    def _attach(self, network: QNetwork, actor: nn.Module) -> None:
        # update_target does it: TorchRL need not warn that no updater is registered
        self._has_update_associated["value_network"] = True  # type: ignore[attr-defined]
        actor_copy = deepcopy(actor)
        self.target_value_network_params.to_module(actor_copy)  # type: ignore[attr-defined]
        networks = [module for module in actor_copy.modules() if isinstance(module, QNetwork)]
        # in __dict__, as TorchRL does with the online module, so that no parameter is listed twice
        config = network.config.agent
        self.__dict__.update(network=network, target_network=networks[0], config=config)
        # losses run deterministic by default; without noise the sigmas would never get a gradient
        self.deterministic_sampling_mode = ExplorationType.RANDOM

    @torch.no_grad()
    def update_target(self) -> None:
        """Copy the online parameters to the target network."""
        # noise is not copied: it is drawn anew before each use
        load_parameters(self.target_network, parameters_of(self.network))

    def forward(self, batch: TensorDictBase) -> TensorDict:
        """Cross-entropy (C51) per transition; Huber loss without a distribution.

        Reads ``observation`` [B, D], ``action`` [B], ``steps_to_next_obs`` [B, 1] and ``next``'s
        ``observation``, ``reward`` and ``terminated`` [B, 1]; where ``next`` has ``action_mask``
        [B, A], the best next action is one that it allows.

        Writes ``td_error`` [B, 1], the priority: the Kullback-Leibler divergence (Hessel et al.
        2018), or without ``kl_priority`` the cross-entropy, which is larger by the entropy of the
        target and is what TorchRL uses; of the Huber loss |error|. Returns ``loss`` [B] and, 0-dim,
        ``clamped_fraction`` (mass of the targets outside the support) and ``mean_q`` (of the best
        next action).
        """
        network, config = self.network, self.config
        # the same noise for both observations: the weights are composed once
        weights = network.weights()
        following = batch.get(("next", "observation"))
        with torch.no_grad():
            target_logits = self.target_network.logits(following)
            # double Q-learning: one network chooses, the other one values
            choosing = network.logits(following, weights) if config.double else target_logits
            mask = batch.get(("next", keys.ACTION_MASK), None)
            best, next_action = allowed_values(network.expected(choosing), mask).max(-1)
        valued = pick(target_logits, next_action)
        logits = pick(network.logits(batch.get("observation"), weights), batch.get("action"))
        if config.distributional:
            returns = bellman(batch, config.gamma, network.support)
            wanted, clamped = project(returns, valued.softmax(-1), network.support)
            loss = -(wanted * logits.log_softmax(-1)).sum(-1)
            priority = loss.detach()
            # the entropy of the target, the rest of the divergence, is not the network's fault
            if config.kl_priority:
                priority = (priority - torch.special.entr(wanted).sum(-1)).clamp_min(0.0)
        else:
            # a single number in place of a distribution; nothing is clamped without a support
            wanted = bellman(batch, config.gamma, valued)
            loss = smooth_l1_loss(logits, wanted, reduction="none").squeeze(-1)
            priority = (wanted - logits.detach()).abs().squeeze(-1)
            clamped = torch.zeros_like(best.mean())
        batch.set("td_error", priority[:, None])
        return TensorDict({"loss": loss, "clamped_fraction": clamped, "mean_q": best.mean()})


class LeanDistributionalLoss(_OfRainbow, DistributionalDQNLoss):
    """Categorical (C51) loss of a distributional ``network``, by its ``config``."""

    def __init__(self, network: QNetwork) -> None:
        # TorchRL's actor gives its loss the parameters and keys; the forward above does not call it
        actor = DistributionalQValueActor(
            network,
            network.support,
            in_keys=["observation"],
            action_space="categorical",
            make_log_softmax=False,
        )
        super().__init__(actor, gamma=network.config.agent.gamma, **_OPTIONS)
        self._attach(network, actor)


class LeanDQNLoss(_OfRainbow, DQNLoss):
    """Plain DQN loss (Huber) of a ``network`` without a distribution, by its ``config``."""

    def __init__(self, network: QNetwork) -> None:
        actor = QValueActor(network, in_keys=["observation"], action_space="categorical")
        super().__init__(
            actor,
            loss_function="smooth_l1",
            double_dqn=network.config.agent.double,
            action_space="categorical",
            **_OPTIONS,
        )
        # For TorchRL's own forward, which would take a discount of its own.
        self.make_value_estimator(gamma=network.config.agent.gamma)
        self._attach(network, actor)


def bellman(batch: TensorDictBase, gamma: float, value: Tensor) -> Tensor:
    """Return of each transition plus the discounted ``value`` [B, K] or [K] of what follows.

    Nothing follows where it terminated.
    """
    # a truncated episode goes on behind its last observation, a terminated one does not
    alive = 1.0 - batch.get(("next", "terminated")).to(value.dtype)
    discount = gamma ** batch.get("steps_to_next_obs")
    return batch.get(("next", "reward")).to(value.dtype) + alive * discount * value


def project(values: Tensor, probabilities: Tensor, support: Tensor) -> tuple[Tensor, Tensor]:
    """Project the distribution with ``probabilities`` at ``values``, [B, K], onto ``support`` [K].

    Returns it, and the mass that is clamped, a mean over the batch, 0-dim.

    Values outside the support are clamped to its ends. Each mass is split between its two
    neighbours in proportion to the nearness of the other (Bellemare et al. 2017, equation 7); the
    mean is kept but for the clamping.
    """
    low = support[0]
    high = support[-1]
    atoms = support.numel()
    # where each value falls on the support, in units of its spacing
    place = (values.clamp(low, high) - low) * ((atoms - 1) / (high - low))
    # the last atom belongs to the interval before it, so that index + 1 exists
    lower = place.floor().clamp_max(atoms - 2)
    share = (place - lower) * probabilities
    index = lower.long()
    projected = torch.zeros_like(probabilities)
    projected.scatter_add_(1, index, probabilities - share)
    projected.scatter_add_(1, index + 1, share)
    # counted before the clamping, weighted by probability
    outside = (values < low) | (values > high)
    return projected, (probabilities * outside).sum(-1).mean()


def pick(rows: Tensor, action: Tensor) -> Tensor:
    """Rows [B, K] of ``rows`` [B, A, K] at the actions [B]."""
    return rows.gather(1, action.view(-1, 1, 1).expand(-1, 1, rows.shape[-1])).squeeze(1)


# --- a whole update as one function


class Batch(NamedTuple):
    """Transitions: ``observation``, ``following`` [B, D], ``allowed`` next [B, A], the rest [B]."""

    observation: Tensor
    action: Tensor
    reward: Tensor
    following: Tensor
    alive: Tensor
    steps: Tensor
    weight: Tensor
    allowed: Tensor


class Learned(NamedTuple):
    """What an update gives: ``priority`` [B], the others 0-dim (``loss`` is weighted)."""

    priority: Tensor
    loss: Tensor
    mean_q: Tensor
    clamped_fraction: Tensor
    gradient_norm: Tensor


class Settings(NamedTuple):
    """What does not change during a training."""

    gamma: float
    gradient_clip: float
    adam_eps: float


def composed_layers(
    parameters: list[Tensor], noise: Sequence[Sequence[Tensor]], actions: int
) -> Weights:
    """Weight and bias of every layer of a network (Fortunato et al. 2017), the duel folded into the
    last.
    """
    layers = []
    for i, (inputs, outputs) in enumerate(noise):
        # four parameters for each layer, in the order of _PARAMETERS
        weight_mu, weight_sigma, bias_mu, bias_sigma = parameters[4 * i : 4 * i + 4]
        # factorised noise: the outer product of one vector per side
        weight = weight_mu + weight_sigma * torch.outer(outputs, inputs)
        layers.append((weight, bias_mu + bias_sigma * outputs))
    weight, bias = layers.pop()
    return [*layers, (folded(weight, actions), folded(bias, actions))]


def folded(part: Tensor, actions: int) -> Tensor:
    """The head's weight [(1 + A) K, H] or bias [(1 + A) K] with the duel in it: [A K, ...]."""
    # Q_a = V + A_a - mean(A), row by row of the weights
    rows = part.unflatten(0, (1 + actions, -1))
    return (rows[:1] + rows[1:] - rows[1:].mean(0, keepdim=True)).flatten(0, 1)


def unfolded(gradient: Tensor, actions: int) -> Tensor:
    """Gradient of the head from that of the folded head: the transpose of :func:`folded`."""
    # V gets the sum of all, each A_a its own less the mean
    rows = gradient.unflatten(0, (actions, -1))
    of_value, of_advantages = rows.sum(0, keepdim=True), rows - rows.mean(0, keepdim=True)
    return torch.cat((of_value, of_advantages)).flatten(0, 1)


def forward(layers: Weights, x: Tensor) -> list[Tensor]:
    """The input of every layer, and the output of the last."""
    inputs = [x]
    for number, (weight, bias) in enumerate(layers):
        relu = number < len(layers) - 1
        inputs.append(matrix_product(inputs[-1], weight, bias, relu))
    return inputs


def gradients(
    layers: Weights,
    noise: Sequence[Sequence[Tensor]],
    inputs: Sequence[Tensor],
    of_logits: Tensor,
    actions: int,
) -> list[Tensor]:
    """Of all parameters, in the layers' order, from that of the folded head's output [B, A K]."""
    all_gradients: list[Tensor] = []
    # from the last layer to the first, by the chain rule
    behind = of_logits
    for number in reversed(range(len(layers))):
        # for each layer: the gradient by its weights, then by its inputs
        of_weight = matrix_product(behind.t(), inputs[number].t())
        of_bias = behind.sum(0)
        # of the folded head's rows, those of value and advantages
        if number == len(layers) - 1:
            of_weight = unfolded(of_weight, actions)
            of_bias = unfolded(of_bias, actions)
        # A weight is mu + sigma * noise, so the gradient of sigma is the weight's times the noise.
        noise_in, noise_out = noise[number]
        all_gradients = [
            of_weight,
            of_weight * torch.outer(noise_out, noise_in),
            of_bias,
            of_bias * noise_out,
            *all_gradients,
        ]
        if number:  # back through the layer's weight and the ReLU before it
            product = matrix_product(behind, layers[number][0].t())
            behind = torch.where(inputs[number] > 0, product, 0.0)
    return all_gradients


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
    """Change ``online`` and Adam's moments ``mean`` and ``square`` in place by one step.

    Args:
        settings: fixed numbers.
        support: of the distribution, [K].
        online, target: parameters, four per layer.
        mean, square: as ``online``.
        noise, target_noise: of each layer's inputs and outputs.
        batch: B transitions.
        rate: learning rate, 0-dim.
        corrections: of Adam's two moments for their start at zero, [2].
    """
    rows, actions = batch.allowed.shape
    layers = composed_layers(online, noise, actions)
    target_layers = composed_layers(target, target_noise, actions)
    # the online network sees both observations in one product
    inputs = forward(layers, torch.cat((batch.observation, batch.following)))
    logits = inputs.pop().unflatten(-1, (actions, -1))

    # the targets: the online network chooses the next action, the target network values it
    best, chosen = allowed_values(logits[rows:].softmax(-1) @ support, batch.allowed).max(-1)
    target_logits = forward(target_layers, batch.following)[-1].unflatten(-1, (actions, -1))
    discount = torch.pow(settings.gamma, batch.steps)
    values = batch.reward[:, None] + (batch.alive * discount)[:, None] * support
    wanted, clamped = project(values, pick(target_logits, chosen).softmax(-1), support)
    # the loss is the cross-entropy, the priority its excess over the target's entropy
    log_p = pick(logits[:rows], batch.action).log_softmax(-1)
    loss = -(wanted * log_p).sum(-1)
    priority = (loss - torch.special.entr(wanted).sum(-1)).clamp_min(0.0)

    # the gradient of the weighted mean of the losses, first by the logits of the taken actions
    # Divided by the number of rows, as in Rainbow, not by the sum of the weights.
    share = (batch.weight / rows)[:, None]
    of_taken = (log_p.exp() * wanted.sum(-1, keepdim=True) - wanted) * share
    is_taken = batch.action[:, None] == torch.arange(actions, device=support.device)
    of_logits = torch.where(is_taken[..., None], of_taken[:, None, :], 0.0).flatten(1)
    by_parameter = gradients(layers, noise, [x[:rows] for x in inputs], of_logits, actions)

    # clipping as by clip_grad_norm_, then Adam
    norm = torch.stack([(gradient * gradient).sum() for gradient in by_parameter]).sum().sqrt()
    scale = (settings.gradient_clip / (norm + 1e-6)).clamp_max(1.0)
    for parameter, gradient, first, second in zip(online, by_parameter, mean, square):
        clipped = gradient * scale
        first.lerp_(clipped, 1.0 - _BETA_1)
        second.mul_(_BETA_2).addcmul_(clipped, clipped, value=1.0 - _BETA_2)
        step = first * corrections[0] / ((second * corrections[1]).sqrt() + settings.adam_eps)
        parameter.sub_(rate * step)
    return Learned(priority, (batch.weight * loss).mean(), best.mean(), clamped, norm)


class UpdateGraph:
    """The compiled :func:`update` of an agent, on the tensors of its networks and its optimiser."""

    def __init__(
        self,
        network: QNetwork,
        target: QNetwork,
        optimizer: torch.optim.Adam,
        config: RainbowConfig,
    ) -> None:
        self.network = network
        self.target = target
        self.optimizer = optimizer
        (group,) = optimizer.param_groups
        self.settings = Settings(config.gamma, config.gradient_clip, group["eps"])
        self.update: Callable[..., Learned] = compiled(update)

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase, generator: torch.Generator) -> Learned:
        """One update on ``batch`` (keys as in :class:`LeanDistributionalLoss`).

        Noise from ``generator``.
        """
        online = _parameters_of(self.network)
        target = _parameters_of(self.target)
        # Adam's own state, so that a run can change to the other way and back
        moments = [self._moments(parameter) for parameter in online]
        # All parameters have made equally many steps, so the first one's count is that of all.
        step = float(moments[0]["step"]) + 1.0
        for state in moments:
            state["step"].fill_(step)
        (group,) = self.optimizer.param_groups
        return self.update(
            self.settings,
            self.network.support,
            [parameter.detach() for parameter in online],
            [parameter.detach() for parameter in target],
            [state["exp_avg"] for state in moments],
            [state["exp_avg_sq"] for state in moments],
            noise_of(self.network, generator),
            noise_of(self.target, generator),
            self._batch(batch),
            # a tensor: a number would be a constant of the graph, compiled anew at each change
            torch.tensor(float(group["lr"])),
            torch.tensor([1.0 / (1.0 - _BETA_1**step), 1.0 / (1.0 - _BETA_2**step)]),
        )

    def _batch(self, batch: TensorDictBase) -> Batch:
        """The tensors of ``batch``; without a mask every next action is allowed."""
        action = batch.get("action")
        following = batch.get("next")
        allowed = following.get(keys.ACTION_MASK, None)
        if allowed is None:
            allowed = torch.ones((len(action), self.network.config.actions), dtype=torch.bool)
        return Batch(
            batch.get("observation"),
            action,
            following.get("reward")[:, 0],
            following.get("observation"),
            (~following.get("terminated")[:, 0]).float(),
            batch.get("steps_to_next_obs")[:, 0].float(),
            batch.get("priority_weight"),
            allowed,
        )

    def _moments(self, parameter: Tensor) -> dict[str, Any]:
        """Adam's state of a parameter, made as Adam makes it at its first step."""
        state = self.optimizer.state[parameter]
        if not state:
            state["step"] = torch.zeros(())
            state["exp_avg"] = torch.zeros_like(parameter)
            state["exp_avg_sq"] = torch.zeros_like(parameter)
        return state


def _parameters_of(network: QNetwork) -> list[Tensor]:
    """Four of each layer, in the order in which :func:`update` takes them."""
    layers = (*network.trunk, network.head)
    return [getattr(layer, name) for layer in layers for name in _PARAMETERS]
