"""Rainbow (Hessel et al. 2018), assembled; each of its six components can be switched off."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from ganlane.agents.drivers import ExploringPolicy, GreedyPolicy, LegalActions
from ganlane.agents.loss import LeanDistributionalLoss, LeanDQNLoss, Learned, UpdateGraph
from ganlane.agents.network import (
    NetworkConfig,
    QNetwork,
    load_parameters,
    noisy_layers,
    parameters_of,
    redraw_noise,
)
from ganlane.agents.replay import load_replay_state, make_replay, replay_state
from ganlane.errors import ParameterError, UserError
from ganlane.settings.agent import RainbowConfig


class Rainbow:
    """The agent: network, target, replay buffer, optimiser, and its own random generators.

    Nothing it does reads or changes torch's global random state.

    Args:
        config: hyperparameters.
        observation_size: D.
        actions: A.
        seed: of weights, noise, random actions and replay.
        device: of everything.
        legal: legal actions for random exploration, see
            :class:`~ganlane.agents.drivers.ExploringPolicy`.
        compile: whether an update runs as one compiled graph
            (:class:`ganlane.agents.loss.UpdateGraph`), where that can do what ``config`` says; the
            same up to rounding, and faster on a CPU.

    Attributes:
        network, target: the online network, which learns, and the one that values.
        policy, greedy: exploring, to collect, and without exploration.
        updates: since the start of the training.
        graph: the compiled update; None: it is computed step by step.

    Raises:
        ParameterError: a learning rate falls, and it is not said within how many decisions.
    """

    def __init__(
        self,
        config: RainbowConfig,
        observation_size: int,
        actions: int = 3,
        seed: int = 0,
        device: torch.device | str = "cpu",
        legal: LegalActions | None = None,
        compile: bool = False,
    ) -> None:
        if config.learning_rate_end is not None and config.learning_rate_decisions == 0:
            raise ParameterError(
                f"{{learning_rate_end}}={config.learning_rate_end:g}: within how many decisions? "
                "set {learning_rate_decisions}, here or by for_phase(); give both or neither."
            )
        self.config = config
        self.device = torch.device(device)
        # One for each purpose: drawing more for one does not change the numbers of the others.
        self.generators = {
            name: torch.Generator(self.device).manual_seed(seed * 3 + i)
            for i, name in enumerate(("collect", "learn", "replay"))
        }

        # Layers draw their initial weights from the global generator, which is put back.
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(seed)
            network = QNetwork(NetworkConfig(config, observation_size, actions))
        self.network = network.to(self.device)
        loss = LeanDistributionalLoss if config.distributional else LeanDQNLoss
        self.loss = loss(self.network)
        self.target = self.loss.target_network

        adam_eps = config.adam_eps
        if adam_eps is None:
            # Rainbow's 1.5e-4 is 0.005 over its batch of 32.
            adam_eps = 0.005 / config.batch_size
        self.optimizer = torch.optim.Adam(
            self.network.parameters(),
            lr=config.learning_rate,
            eps=adam_eps,
            fused=True,
        )
        self.replay = make_replay(config, self.generators["replay"])

        # One network, two ways to drive with it.
        self.policy = ExploringPolicy(self.network, self.generators["collect"], legal)
        self.greedy = GreedyPolicy(self.network)

        # The graph is of the whole of Rainbow; with any part left out the update is computed step
        # by step.
        parts = ("distributional", "double", "dueling", "noisy", "prioritised", "kl_priority")
        is_whole = all(getattr(config, part) for part in parts)
        self.graph: UpdateGraph | None = None
        if compile and is_whole and self.device.type == "cpu":
            self.graph = UpdateGraph(self.network, self.target, self.optimizer, config)

        self.updates = 0
        self.anneal(0)

    @property
    def ready(self) -> bool:
        """Whether the buffer holds enough to learn from."""
        return len(self.replay) >= self.config.warmup

    def anneal(self, decisions: int) -> None:
        """Set the share of random actions and the learning rate after ``decisions``."""
        config = self.config
        self.policy.epsilon = annealed(
            config.epsilon_start,
            config.epsilon,
            decisions,
            config.epsilon_decisions,
        )
        if config.learning_rate_end is not None:
            (group,) = self.optimizer.param_groups
            group["lr"] = annealed(
                config.learning_rate,
                config.learning_rate_end,
                decisions,
                config.learning_rate_decisions,
            )

    def store(self, transition: TensorDict | None) -> None:
        """Add the transitions of :meth:`NStepWindow.push`, batch [N]; None adds nothing."""
        if transition is not None:
            self.replay.extend(transition, update_priority=False)

    def update(self) -> dict[str, Tensor]:
        """One step of gradient descent on a batch from the replay buffer.

        Returns:
            0-dim tensors to log, still on the device: the fields of
            :class:`~ganlane.agents.loss.Learned`, of the priorities their mean.
        """
        config = self.config
        if config.prioritised:
            # The weights make up for the priorities more and more, at the end in full.
            beta = annealed(config.beta_start, 1.0, self.updates, config.beta_updates)
            self.replay.sampler.beta = beta
        batch = self.replay.sample()

        # Both change the same parameters and the same state of Adam.
        descend = self._descend if self.graph is None else self.graph
        learned = descend(batch, self.generators["learn"])

        # Only what was drawn gets a new priority; the rest keeps its own until it is drawn.
        if config.prioritised:
            self.replay.sampler.update_priority(batch.get("index"), learned.priority)

        self.updates += 1
        # A hard copy, as in Rainbow.
        if self.updates % config.target_period == 0:
            self.loss.update_target()
        return {**learned._asdict(), "priority": learned.priority.mean()}

    def _descend(self, batch: TensorDict, generator: torch.Generator) -> Learned:
        """What :class:`~ganlane.agents.loss.UpdateGraph` does, for every ``config`` and device."""
        # Both networks get new noise for every update.
        redraw_noise(self.network, generator)
        redraw_noise(self.target, generator)

        terms = self.loss(batch)
        # Without priorities all weigh the same.
        weight = batch.get("priority_weight", 1.0)
        # Rainbow's mean of w * loss; TorchRL's own 'mean' divides by the sum of the weights.
        objective = (weight * terms["loss"]).mean()

        self.optimizer.zero_grad(set_to_none=True)
        objective.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.config.gradient_clip)
        self.optimizer.step()
        return Learned(
            priority=batch.get("td_error")[:, 0],
            loss=objective.detach(),
            mean_q=terms["mean_q"],
            clamped_fraction=terms["clamped_fraction"],
            gradient_norm=norm,
        )

    def sigma(self) -> Tensor:
        """Mean absolute noise parameter over the weights of the noisy layers, 0-dim.

        0 without noise.
        """
        # Of the weights alone: those of the biases are few.
        sigmas = [layer.weight_sigma.detach().abs().mean() for layer in noisy_layers(self.network)]
        if not sigmas:
            return torch.zeros(())
        return torch.stack(sigmas).mean()

    def weights(self) -> dict[str, Tensor]:
        """The online network's parameters, without its momentary noise."""
        return parameters_of(self.network)

    def load_weights(self, weights: Mapping[str, Tensor]) -> None:
        """Start from trained ``weights``: load them first, then let the target follow."""
        load_parameters(self.network, weights)
        self.loss.update_target()

    def state_dict(self, with_replay: bool = True) -> dict[str, Any]:
        """Tensors and plain data for a bit-exact resume; noise is redrawn before use, so it is not
        among them.

        Without the buffer a resume is not exact anyway, so Adam's moments are kept in bfloat16.
        """
        optimizer = self.optimizer.state_dict()
        if not with_replay:
            for row, moments in optimizer["state"].items():
                # Loading brings the moments back to the weights' type.
                halves = {name: moments[name].bfloat16() for name in ("exp_avg", "exp_avg_sq")}
                # A new dictionary: this one is the optimiser's own.
                optimizer["state"][row] = {**moments, **halves}
        return {
            "config": asdict(self.config),
            "network": self.weights(),
            "target": parameters_of(self.target),
            "optimizer": optimizer,
            "generators": {
                name: generator.get_state() for name, generator in self.generators.items()
            },
            "updates": self.updates,
            "replay": replay_state(self.replay) if with_replay else None,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore :meth:`state_dict`; if it was made without the buffer, the buffer is empty
        afterwards.

        Raises:
            UserError: it is the state of an agent with other hyperparameters or another
                observation.
            ValueError: Adam's moments are of other weights.
        """
        for name, value in asdict(self.config).items():
            saved = state["config"][name]
            if saved != value:
                raise UserError(
                    f"agent.{name}={value}: the saved agent has {saved}; give the same to go on "
                    "from it."
                )

        # In place: policies, losses and optimiser keep their references.
        load_parameters(self.network, state["network"])
        load_parameters(self.target, state["target"])

        # Adam would write beyond moments that are too short; before the first update there are
        # none.
        moments = state["optimizer"]["state"]
        shapes = [parameter.shape for parameter in self.network.parameters()]
        for name in ("exp_avg", "exp_avg_sq"):
            if moments and [moments[row][name].shape for row in moments] != shapes:
                raise ValueError("the optimiser's moments are of other weights")
        # Learning rate and eps stay those of this run.
        self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": moments})

        for name, generator in self.generators.items():
            generator.set_state(state["generators"][name].cpu())
        self.updates = state["updates"]

        # Without the buffer in the state it is filled again by the run.
        self.replay.empty()
        if state["replay"] is not None:
            load_replay_state(self.replay, state["replay"])


def annealed(start: float, end: float, done: int, total: int) -> float:
    """From ``start`` to ``end`` in a straight line over ``total``, then ``end``."""
    # A total of 0 is over at once.
    if done >= total:
        return end
    return start + (end - start) * done / total
