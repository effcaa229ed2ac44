"""TorchRL's DQN losses with a lean forward on plain tensors.

:class:`LeanDistributionalLoss` equals :class:`torchrl.objectives.DistributionalDQNLoss` (Bellemare et al. 2017,
double) to 1e-6 and takes half of its time; :class:`LeanDQNLoss` does the same for the plain DQN loss. Both keep
TorchRL's parameter containers, so a TorchRL user finds ``value_network_params`` and the target where expected.
"""

from __future__ import annotations

from copy import deepcopy

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType
from torchrl.modules import DistributionalQValueActor, QValueActor
from torchrl.objectives import DistributionalDQNLoss, DQNLoss

from ganlane import keys
from ganlane.agents.network import QNetwork, Weights
from ganlane.agents.policy import allowed_values
from ganlane.parameters.agent import RainbowConfig


class _WithTarget:
    """Mixin: a second module whose tensors are the loss's target parameters, so that its noise can be drawn anew."""

    target_network: QNetwork
    network: QNetwork

    def _attach(self, network: QNetwork, actor: nn.Module) -> None:
        # The target is updated here, by update_target: TorchRL need not warn that no updater is registered.
        self._has_update_associated["value_network"] = True  # type: ignore[attr-defined]
        actor_copy = deepcopy(actor)
        self.target_value_network_params.to_module(actor_copy)  # type: ignore[attr-defined]
        # In __dict__, as TorchRL does with the online module, so that no parameter is listed twice.
        self.__dict__["network"] = network
        self.__dict__["target_network"] = next(m for m in actor_copy.modules() if isinstance(m, QNetwork))
        # Losses run deterministic by default; without noise the sigmas would never get a gradient.
        self.deterministic_sampling_mode = ExplorationType.RANDOM

    @torch.no_grad()
    def update_target(self) -> None:
        """Copy the online parameters to the target network."""
        for target, online in zip(self.target_network.parameters(), self.network.parameters()):
            target.copy_(online)


class LeanDistributionalLoss(_WithTarget, DistributionalDQNLoss):
    """Categorical (C51) loss, double or not.

    Args:
        network: distributional Q-network.
        gamma: discount per decision; a transition over k decisions is discounted by ``gamma ** k``.
        double: choose the next action by the online network rather than by the target network.
        kl_priority: ``td_error`` is the Kullback-Leibler divergence (Hessel et al. 2018) rather than the
            cross-entropy, which is larger by the entropy of the target and is what TorchRL uses.
    """

    def __init__(self, network: QNetwork, gamma: float, double: bool = True, kl_priority: bool = True) -> None:
        actor = DistributionalQValueActor(
            network, network.support, in_keys=["observation"], action_space="categorical", make_log_softmax=False
        )
        super().__init__(actor, gamma=gamma, delay_value=True, reduction="none", use_prioritized_weights=False)
        self.double, self.kl_priority = double, kl_priority
        self._attach(network, actor)

    def forward(self, batch: TensorDictBase) -> TensorDict:
        """Cross-entropy per transition.

        Reads ``observation`` [B, D], ``action`` [B], ``steps_to_next_obs`` [B, 1] and ``next``'s ``observation``,
        ``reward`` and ``terminated`` [B, 1]; where ``next`` has ``action_mask`` [B, A], the best next action is one
        that it allows. Writes ``td_error`` [B, 1]. Returns ``loss`` [B] and, 0-dim,
        ``clamped_fraction`` (mass of the targets outside the support) and ``mean_q`` (of the best next action).
        """
        weights = self.network.weights()
        with torch.no_grad():
            target, clamped, mean_q = self._target(batch, weights)
        logits = self.network.logits(batch.get("observation"), weights)
        log_p = pick(logits, batch.get("action")).log_softmax(-1)
        loss = -(target * log_p).sum(-1)
        priority = loss.detach()
        if self.kl_priority:
            priority = (priority - torch.special.entr(target).sum(-1)).clamp_min(0.0)
        batch.set("td_error", priority[:, None])
        return TensorDict({"loss": loss, "clamped_fraction": clamped, "mean_q": mean_q})

    def _target(self, batch: TensorDictBase, weights: Weights) -> tuple[Tensor, Tensor, Tensor]:
        """Projected distribution of the Bellman targets [B, atoms], its clamped mass, the mean best value."""
        following, support = batch.get(("next", "observation")), self.network.support
        target_logits = self.target_network.logits(following)
        choosing = self.network.logits(following, weights) if self.double else target_logits
        values = allowed_values(self.network.expected(choosing), batch.get(("next", keys.ACTION_MASK), None))
        best, action = values.max(-1)
        probabilities = pick(target_logits, action).softmax(-1)
        values = bellman(batch, self.gamma, support)
        clamped = outside_support(values, probabilities, support)
        return project(values, probabilities, support), clamped, best.mean()


class LeanDQNLoss(_WithTarget, DQNLoss):
    """Plain DQN loss (Huber), double or not: Rainbow with ``distributional=False``."""

    def __init__(self, network: QNetwork, gamma: float, double: bool = True) -> None:
        actor = QValueActor(network, in_keys=["observation"], action_space="categorical")
        super().__init__(
            actor,
            loss_function="smooth_l1",
            delay_value=True,
            double_dqn=double,
            action_space="categorical",
            reduction="none",
            use_prioritized_weights=False,
        )
        self.make_value_estimator(gamma=gamma)
        self.discount = gamma
        self._attach(network, actor)

    def forward(self, batch: TensorDictBase) -> TensorDict:
        """Huber loss per transition; keys as in :meth:`LeanDistributionalLoss.forward`, ``td_error`` is |error|."""
        with torch.no_grad():
            target, mean_q = self._target(batch)
        values = self.network(batch.get("observation"))
        value = values.gather(-1, batch.get("action")[:, None]).squeeze(-1)
        loss = nn.functional.smooth_l1_loss(value, target, reduction="none")
        batch.set("td_error", (target - value.detach()).abs()[:, None])
        return TensorDict({"loss": loss, "clamped_fraction": torch.zeros_like(mean_q), "mean_q": mean_q})

    def _target(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Bellman targets [B] and the mean value of the best next action."""
        following = batch.get(("next", "observation"))
        target_values = self.target_network(following)
        values = self.network(following) if self.double_dqn else target_values
        best, action = allowed_values(values, batch.get(("next", keys.ACTION_MASK), None)).max(-1)
        value = target_values.gather(-1, action[:, None])
        return bellman(batch, self.discount, value).squeeze(-1), best.mean()


def make_loss(network: QNetwork, config: RainbowConfig) -> LeanDistributionalLoss | LeanDQNLoss:
    """The loss that ``config`` asks for."""
    if config.distributional:
        return LeanDistributionalLoss(network, config.gamma, config.double, config.kl_priority)
    return LeanDQNLoss(network, config.gamma, config.double)


def bellman(batch: TensorDictBase, gamma: float, value: Tensor) -> Tensor:
    """Return of each transition plus the discounted ``value`` [B, K] or [K] of what follows, unless it terminated."""
    alive = 1.0 - batch.get(("next", "terminated")).to(value.dtype)
    discount = gamma ** batch.get("steps_to_next_obs")
    return batch.get(("next", "reward")).to(value.dtype) + alive * discount * value


def project(values: Tensor, probabilities: Tensor, support: Tensor) -> Tensor:
    """Project the distribution with ``probabilities`` [B, K] at ``values`` [B, K] onto ``support`` [K].

    Values outside the support are clamped to its ends. Each mass is split between its two neighbours in proportion
    to the nearness of the other (Bellemare et al. 2017, equation 7); the mean is kept but for the clamping.
    """
    low, high, atoms = support[0], support[-1], support.numel()
    place = (values.clamp(low, high) - low) * ((atoms - 1) / (high - low))
    lower = place.floor().clamp_max(atoms - 2)
    share = (place - lower) * probabilities
    index = lower.long()
    projected = torch.zeros_like(probabilities)
    projected.scatter_add_(1, index, probabilities - share)
    return projected.scatter_add_(1, index + 1, share)


def outside_support(values: Tensor, probabilities: Tensor, support: Tensor) -> Tensor:
    """Probability mass that :func:`project` clamps, averaged over the batch, 0-dim."""
    outside = (values < support[0]) | (values > support[-1])
    return (probabilities * outside).sum(-1).mean()


def pick(rows: Tensor, action: Tensor) -> Tensor:
    """Rows [B, K] of ``rows`` [B, A, K] at the actions [B]."""
    return rows.gather(1, action.view(-1, 1, 1).expand(-1, 1, rows.shape[-1])).squeeze(1)
