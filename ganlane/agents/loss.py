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
#: Of TorchRL's losses: a target network, and a loss per transition, which the agent weights itself.
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

    Attributes:
        network: that learns.
        target_network: that values the next actions.
        config: of the agent.
    """

    network: QNetwork
    target_network: QNetwork
    config: RainbowConfig

    def _attach(self, network: QNetwork, actor: nn.Module) -> None:
        """Give the loss its networks: ``network`` in ``actor``, and a copy with the target's
        parameters.
        """
        # update_target does it: TorchRL need not warn that no updater is registered.
        self._has_update_associated["value_network"] = True  # type: ignore[attr-defined]

        actor_copy = deepcopy(actor)
        self.target_value_network_params.to_module(actor_copy)  # type: ignore[attr-defined]
        networks = [module for module in actor_copy.modules() if isinstance(module, QNetwork)]

        # In __dict__, as TorchRL does with the online module, so that no parameter is listed twice.
        self.__dict__.update(
            network=network,
            target_network=networks[0],
            config=network.config.agent,
        )
        # Losses run deterministic by default; without noise the sigmas would never get a gradient.
        self.deterministic_sampling_mode = ExplorationType.RANDOM

    @torch.no_grad()
    def update_target(self) -> None:
        """Copy the online parameters to the target network."""
        # Noise is not copied: it is drawn anew before each use.
        load_parameters(self.target_network, parameters_of(self.network))

    def forward(self, batch: TensorDictBase) -> TensorDict:
        """Cross-entropy (C51) per transition; Huber loss without a distribution.

        Writes ``td_error`` [B, 1], the priority: the Kullback-Leibler divergence (Hessel et al.
        2018), or without ``kl_priority`` the cross-entropy, which is larger by the entropy of the
        target and is what TorchRL uses; of the Huber loss |error|.

        Args:
            batch: with ``observation`` [B, D], ``action`` [B], ``steps_to_next_obs`` [B, 1] and
                ``next``'s ``observation`` [B, D], ``reward`` and ``terminated`` [B, 1]; where
                ``next`` has ``action_mask`` [B, A], the best next action is one that it allows.

        Returns:
            ``loss`` [B] and, 0-dim, ``clamped_fraction`` (mass of the targets outside the support)
            and ``mean_q`` (of the best next action).
        """
        network = self.network
        config = self.config
        # The same noise for both observations: the weights are composed once.
        weights = network.weights()

        # What the best next action is worth, by the target network: logits [B, atoms].
        following = batch.get(("next", "observation"))
        with torch.no_grad():
            target_logits = self.target_network.logits(following)
            # Double Q-learning: one network chooses, the other one values.
            choosing = network.logits(following, weights) if config.double else target_logits
            mask = batch.get(("next", keys.ACTION_MASK), None)
            best, next_action = allowed_values(network.expected(choosing), mask).max(-1)
        valued = pick(target_logits, next_action)

        # What the online network says of the action that was taken, [B, atoms].
        all_logits = network.logits(batch.get("observation"), weights)
        logits = pick(all_logits, batch.get("action"))

        if config.distributional:
            returns = bellman(batch, config.gamma, network.support)
            wanted, clamped = project(returns, valued.softmax(-1), network.support)
            loss = -(wanted * logits.log_softmax(-1)).sum(-1)
            priority = loss.detach()
            # The entropy of the target, the rest of the divergence, is not the network's fault.
            if config.kl_priority:
                entropy = torch.special.entr(wanted).sum(-1)
                priority = (priority - entropy).clamp_min(0.0)
        else:
            # A single number in place of a distribution; nothing is clamped without a support.
            wanted = bellman(batch, config.gamma, valued)
            loss = smooth_l1_loss(logits, wanted, reduction="none").squeeze(-1)
            priority = (wanted - logits.detach()).abs().squeeze(-1)
            clamped = torch.zeros_like(best.mean())

        batch.set("td_error", priority[:, None])
        return TensorDict({"loss": loss, "clamped_fraction": clamped, "mean_q": best.mean()})


class LeanDistributionalLoss(_OfRainbow, DistributionalDQNLoss):
    """Categorical (C51) loss of a distributional ``network``, by its ``config``.

    Bellemare et al. 2017; with ``config.double`` the double one of Rainbow.
    """

    def __init__(self, network: QNetwork) -> None:
        # TorchRL's actor gives its loss the parameters and keys; the forward above does not call
        # it.
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
    """Return of each transition plus the discounted ``value`` of what follows, [B, K].

    Nothing follows where it terminated.

    Args:
        batch: B transitions, with keys as in :class:`LeanDistributionalLoss`.
        gamma: discount per decision.
        value: [B, K], or [K] the same for all.
    """
    # A truncated episode goes on behind its last observation, a terminated one does not.
    alive = 1.0 - batch.get(("next", "terminated")).to(value.dtype)
    discount = gamma ** batch.get("steps_to_next_obs")
    reward = batch.get(("next", "reward")).to(value.dtype)
    return reward + alive * discount * value


def project(values: Tensor, probabilities: Tensor, support: Tensor) -> tuple[Tensor, Tensor]:
    """Project the distribution with ``probabilities`` at ``values``, [B, K], onto ``support`` [K].

    Values outside the support are clamped to its ends. Each mass is split between its two
    neighbours in proportion to the nearness of the other (Bellemare et al. 2017, equation 7); the
    mean is kept but for the clamping.

    Returns:
        The probabilities [B, K] at the support, and the mass that is clamped, a mean over the
        batch, 0-dim.
    """
    low = support[0]
    high = support[-1]
    atoms = support.numel()

    # Where each value falls on the support, in units of its spacing.
    place = (values.clamp(low, high) - low) * ((atoms - 1) / (high - low))
    # The last atom belongs to the interval before it, so that index + 1 exists.
    lower = place.floor().clamp_max(atoms - 2)

    # The upper neighbour gets this share of the mass, the lower one the rest.
    share = (place - lower) * probabilities
    index = lower.long()
    projected = torch.zeros_like(probabilities)
    projected.scatter_add_(1, index, probabilities - share)
    projected.scatter_add_(1, index + 1, share)

    # Counted before the clamping, weighted by probability.
    outside = (values < low) | (values > high)
    clamped = (probabilities * outside).sum(-1).mean()
    return projected, clamped


def pick(rows: Tensor, action: Tensor) -> Tensor:
    """Rows [B, K] of ``rows`` [B, A, K] at the actions [B]."""
    index = action.view(-1, 1, 1).expand(-1, 1, rows.shape[-1])
    return rows.gather(1, index).squeeze(1)


# --- a whole update as one function


class Batch(NamedTuple):
    """B transitions.

    Attributes:
        observation, following: before and after, [B, D].
        action: int64 [B].
        reward: n-step return, [B].
        alive: 0 where it terminated, else 1, [B].
        steps: exponent of the discount of what follows, [B].
        weight: of its loss, [B].
        allowed: next actions, bool [B, A].
    """

    observation: Tensor
    action: Tensor
    reward: Tensor
    following: Tensor
    alive: Tensor
    steps: Tensor
    weight: Tensor
    allowed: Tensor


class Learned(NamedTuple):
    """What an update gives; 0-dim unless said otherwise.

    Attributes:
        priority: of the transitions, [B].
        loss: weighted mean over the batch.
        mean_q: mean value of the best next actions.
        clamped_fraction: mass of the targets outside the support.
        gradient_norm: before the clipping.
    """

    priority: Tensor
    loss: Tensor
    mean_q: Tensor
    clamped_fraction: Tensor
    gradient_norm: Tensor


class Settings(NamedTuple):
    """What does not change during a training.

    Attributes:
        gamma: discount per decision.
        gradient_clip: largest norm of the gradient of all parameters.
        adam_eps: Adam's epsilon.
    """

    gamma: float
    gradient_clip: float
    adam_eps: float


def composed_layers(
    parameters: list[Tensor],
    noise: Sequence[Sequence[Tensor]],
    actions: int,
) -> Weights:
    """Weight and bias of every layer of a network (Fortunato et al. 2017), the duel folded into the
    last.

    Args:
        parameters: four per layer.
        noise: of each layer's inputs and outputs.
        actions: A.
    """
    layers = []
    for i, (inputs, outputs) in enumerate(noise):
        # Four parameters for each layer, in the order of _PARAMETERS.
        weight_mu, weight_sigma, bias_mu, bias_sigma = parameters[4 * i : 4 * i + 4]
        # Factorised noise: the outer product of one vector per side.
        weight = weight_mu + weight_sigma * torch.outer(outputs, inputs)
        bias = bias_mu + bias_sigma * outputs
        layers.append((weight, bias))

    weight, bias = layers.pop()
    head = (folded(weight, actions), folded(bias, actions))
    return [*layers, head]


def folded(part: Tensor, actions: int) -> Tensor:
    """The head's weight [(1 + A) K, H] or bias [(1 + A) K] with the duel in it: [A K, ...]."""
    rows = part.unflatten(0, (1 + actions, -1))
    of_value = rows[:1]
    of_advantages = rows[1:]
    # Q_a = V + A_a - mean(A), row by row of the weights.
    of_actions = of_value + of_advantages - of_advantages.mean(0, keepdim=True)
    return of_actions.flatten(0, 1)


def unfolded(gradient: Tensor, actions: int) -> Tensor:
    """Gradient of the head from that of the folded head: the transpose of :func:`folded`."""
    # V gets the sum of all, each A_a its own less the mean.
    rows = gradient.unflatten(0, (actions, -1))
    of_value = rows.sum(0, keepdim=True)
    of_advantages = rows - rows.mean(0, keepdim=True)
    return torch.cat((of_value, of_advantages)).flatten(0, 1)


def forward(layers: Weights, x: Tensor) -> list[Tensor]:
    """The input of every layer, and the output of the last, for observations ``x`` [B, D]."""
    inputs = [x]
    for number, (weight, bias) in enumerate(layers):
        # After every layer but the last.
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
    """Of all parameters, four per layer, in the layers' order.

    Args:
        layers: of :func:`composed_layers`.
        noise: of each layer's inputs and outputs.
        inputs: of every layer, [B, ...] each.
        of_logits: gradient of the folded head's output, [B, A K].
        actions: A.
    """
    all_gradients: list[Tensor] = []
    # From the last layer to the first, by the chain rule: ``behind`` is the gradient of the
    # layer's output.
    behind = of_logits
    for number in reversed(range(len(layers))):
        # First the gradient of the layer's weights.
        of_weight = matrix_product(behind.t(), inputs[number].t())
        of_bias = behind.sum(0)
        # Of the folded head's rows, those of value and advantages.
        if number == len(layers) - 1:
            of_weight = unfolded(of_weight, actions)
            of_bias = unfolded(of_bias, actions)

        # A weight is mu + sigma * noise, so the gradient of sigma is the weight's times the noise.
        noise_in, noise_out = noise[number]
        of_weight_sigma = of_weight * torch.outer(noise_out, noise_in)
        of_bias_sigma = of_bias * noise_out
        # In the order of _PARAMETERS, before those of the layers behind.
        all_gradients = [of_weight, of_weight_sigma, of_bias, of_bias_sigma, *all_gradients]

        # Then that of its inputs: back through the weight and the ReLU before it.
        if number:
            weight, _ = layers[number]
            product = matrix_product(behind, weight.t())
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

    # The online network sees both observations in one product: logits [2 B, A, K].
    inputs = forward(layers, torch.cat((batch.observation, batch.following)))
    logits = inputs.pop().unflatten(-1, (actions, -1))
    logits_before = logits[:rows]
    logits_after = logits[rows:]

    # The targets: the online network chooses the next action, the target network values it.
    next_values = allowed_values(logits_after.softmax(-1) @ support, batch.allowed)
    best, chosen = next_values.max(-1)
    target_logits = forward(target_layers, batch.following)[-1].unflatten(-1, (actions, -1))
    probabilities = pick(target_logits, chosen).softmax(-1)
    discount = torch.pow(settings.gamma, batch.steps)
    returns = batch.reward[:, None] + (batch.alive * discount)[:, None] * support
    wanted, clamped = project(returns, probabilities, support)

    # The loss is the cross-entropy, the priority its excess over the target's entropy.
    log_p = pick(logits_before, batch.action).log_softmax(-1)
    loss = -(wanted * log_p).sum(-1)
    entropy = torch.special.entr(wanted).sum(-1)
    priority = (loss - entropy).clamp_min(0.0)

    # The gradient of the weighted mean of the losses, first by the logits of the taken actions.
    # Divided by the number of rows, as in Rainbow, not by the sum of the weights.
    share = (batch.weight / rows)[:, None]
    of_taken = (log_p.exp() * wanted.sum(-1, keepdim=True) - wanted) * share
    # Those of the other actions have none: [B, A, K], then [B, A K].
    is_taken = batch.action[:, None] == torch.arange(actions, device=support.device)
    of_logits = torch.where(is_taken[..., None], of_taken[:, None, :], 0.0).flatten(1)
    inputs_before = [x[:rows] for x in inputs]
    by_parameter = gradients(layers, noise, inputs_before, of_logits, actions)

    # Clipping as by clip_grad_norm_.
    squares = [(gradient * gradient).sum() for gradient in by_parameter]
    norm = torch.stack(squares).sum().sqrt()
    scale = (settings.gradient_clip / (norm + 1e-6)).clamp_max(1.0)

    # Adam, on the tensors of the networks and of the optimiser themselves.
    for parameter, gradient, first, second in zip(online, by_parameter, mean, square):
        clipped = gradient * scale
        first.lerp_(clipped, 1.0 - _BETA_1)
        second.mul_(_BETA_2).addcmul_(clipped, clipped, value=1.0 - _BETA_2)
        deviation = (second * corrections[1]).sqrt()
        step = first * corrections[0] / (deviation + settings.adam_eps)
        parameter.sub_(rate * step)

    weighted_loss = (batch.weight * loss).mean()
    return Learned(priority, weighted_loss, best.mean(), clamped, norm)


class UpdateGraph:
    """The compiled :func:`update` of an agent, on the tensors of its networks and its optimiser.

    Args:
        network, target: with all six components of Rainbow, on a CPU.
        optimizer: of the parameters of ``network``; its state is made and changed here.
        config: of the agent.
    """

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

        # Adam's own state, so that a run can change to the other way and back.
        moments = [self._moments(parameter) for parameter in online]
        # All parameters have made equally many steps, so the first one's count is that of all.
        step = float(moments[0]["step"]) + 1.0
        for state in moments:
            state["step"].fill_(step)
        corrections = [1.0 / (1.0 - _BETA_1**step), 1.0 / (1.0 - _BETA_2**step)]
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
            # Tensors: a number would be a constant of the graph, compiled anew at each change.
            torch.tensor(float(group["lr"])),
            torch.tensor(corrections),
        )

    def _batch(self, batch: TensorDictBase) -> Batch:
        """The tensors of ``batch``; without a mask every next action is allowed."""
        action = batch.get("action")
        following = batch.get("next")
        allowed = following.get(keys.ACTION_MASK, None)
        if allowed is None:
            shape = (len(action), self.network.config.actions)
            allowed = torch.ones(shape, dtype=torch.bool)
        return Batch(
            observation=batch.get("observation"),
            action=action,
            reward=following.get("reward")[:, 0],
            following=following.get("observation"),
            alive=(~following.get("terminated")[:, 0]).float(),
            steps=batch.get("steps_to_next_obs")[:, 0].float(),
            weight=batch.get("priority_weight"),
            allowed=allowed,
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
