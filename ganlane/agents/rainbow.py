"""Rainbow (Hessel et al. 2018), assembled; each of its six components can be switched off."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from ganlane.agents.free_decisions import FreeDecisionWindow
from ganlane.agents.loss import make_loss
from ganlane.agents.n_step import NStepWindow
from ganlane.agents.network import NetworkConfig, QNetwork, load_parameters, parameters_of
from ganlane.agents.noise import mean_sigma, redraw_noise
from ganlane.agents.policy import ExploringPolicy, GreedyPolicy, LegalActions
from ganlane.agents.replay import annealed, make_replay
from ganlane.agents.resume import agent_state, load_agent_state
from ganlane.errors import ParameterError
from ganlane.parameters.agent import RainbowConfig


class Rainbow:
    """The agent: network, target, replay buffer, optimiser, and its own random generators.

    Nothing it does reads or changes torch's global random state.

    Args:
        config: hyperparameters.
        observation_size: D.
        actions: A.
        seed: of weights, noise, random actions and replay.
        device: of everything.
        legal: legal actions for random exploration, see :class:`~ganlane.agents.policy.ExploringPolicy`.
    """

    def __init__(
        self,
        config: RainbowConfig,
        observation_size: int,
        actions: int = 3,
        seed: int = 0,
        device: torch.device | str = "cpu",
        legal: LegalActions | None = None,
    ) -> None:
        if config.learning_rate_end is not None and config.learning_rate_decisions == 0:
            raise ParameterError(
                f"{{learning_rate_end}}={config.learning_rate_end:g}: within how many decisions? set "
                "{learning_rate_decisions}, here or by for_phase(); give both or neither."
            )
        self.config, self.device = config, torch.device(device)
        self.generators = {
            name: torch.Generator(self.device).manual_seed(seed * 3 + i)
            for i, name in enumerate(("collect", "learn", "replay"))
        }
        self.network = _fresh_network(NetworkConfig.of(config, observation_size, actions), seed).to(self.device)
        self.loss = make_loss(self.network, config)
        self.optimizer = _adam(self.network, config)
        self.replay = make_replay(
            config.capacity,
            config.batch_size,
            self.generators["replay"],
            config.prioritised,
            config.alpha,
            config.beta_start,
        )
        self.policy = ExploringPolicy(self.network, self.generators["collect"], legal)
        self.greedy = GreedyPolicy(self.network)
        self.updates = 0
        self.anneal(0)

    @property
    def ready(self) -> bool:
        """Whether the buffer holds enough to learn from."""
        return len(self.replay) >= self.config.warmup

    def window(self) -> NStepWindow | FreeDecisionWindow:
        """A fresh n-step window for a batch of environments."""
        kind = FreeDecisionWindow if self.config.decide_when_free else NStepWindow
        return kind(self.config.n_step, self.config.gamma)

    def anneal(self, decisions: int) -> None:
        """Set the share of random actions and the learning rate after ``decisions``."""
        config = self.config
        share = annealed(config.epsilon_start, config.epsilon, decisions, config.epsilon_decisions)
        self.policy.epsilon = share
        if config.learning_rate_end is not None:
            now = annealed(config.learning_rate, config.learning_rate_end, decisions, config.learning_rate_decisions)
            for group in self.optimizer.param_groups:
                group["lr"] = now

    def store(self, transition: TensorDict | None) -> None:
        """Add transitions, batch [N], with the keys of :meth:`NStepWindow.push`; None adds nothing."""
        if transition is not None:
            self.replay.extend(transition, update_priority=False)

    def update(self) -> dict[str, Tensor]:
        """One step of gradient descent; 0-dim tensors to log, read without a host synchronisation."""
        batch = self._sample()
        for module in (self.network, self.loss.target_network):
            redraw_noise(module, self.generators["learn"])
        terms = self.loss(batch)
        weight = batch.get("priority_weight", None)
        # Rainbow's mean of w * loss; TorchRL's own 'mean' divides by the sum of the weights.
        objective = (terms["loss"] if weight is None else weight * terms["loss"]).mean()
        gradient_norm = self._descend(objective)
        if self.config.prioritised:
            self.replay.update_priority(batch.get("index"), batch.get("td_error"))
        self.updates += 1
        if self.updates % self.config.target_period == 0:
            self.loss.update_target()
        return {
            "loss": objective.detach(),
            "mean_q": terms["mean_q"],
            "clamped_fraction": terms["clamped_fraction"],
            "priority": batch.get("td_error").mean(),
            "gradient_norm": gradient_norm,
        }

    def _sample(self) -> TensorDict:
        """A batch, with the exponent of its importance weights annealed."""
        if self.config.prioritised:
            config = self.config
            self.replay.sampler.beta = annealed(config.beta_start, 1.0, self.updates, config.beta_updates)
        return self.replay.sample()

    def _descend(self, objective: Tensor) -> Tensor:
        """Clip and apply the gradient; return its norm before clipping, 0-dim."""
        self.optimizer.zero_grad(set_to_none=True)
        objective.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.config.gradient_clip)
        self.optimizer.step()
        return norm

    def sigma(self) -> Tensor:
        """Mean noise parameter, 0-dim."""
        return mean_sigma(self.network)

    def load_weights(self, weights: Mapping[str, Tensor]) -> None:
        """Start from trained ``weights`` (transfer): load them first, then let the target follow."""
        load_parameters(self.network, weights)
        self.loss.update_target()

    def weights(self) -> dict[str, Tensor]:
        """The online network's parameters, without its momentary noise."""
        return parameters_of(self.network)

    def state_dict(self, with_replay: bool = True) -> dict[str, Any]:
        """Everything an exact resume needs (:func:`ganlane.agents.resume.agent_state`)."""
        return agent_state(self, with_replay)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore :meth:`state_dict` (:func:`ganlane.agents.resume.load_agent_state`)."""
        load_agent_state(self, state)


def _fresh_network(config: NetworkConfig, seed: int) -> QNetwork:
    """Weights drawn from ``seed``, torch's global random state as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        return QNetwork(config)


def _adam(network: QNetwork, config: RainbowConfig) -> torch.optim.Optimizer:
    """The optimiser of all parameters."""
    eps = 0.005 / config.batch_size if config.adam_eps is None else config.adam_eps
    return torch.optim.Adam(network.parameters(), lr=config.learning_rate, eps=eps, fused=True)
