"""The reward of section V.C as a TorchRL transform, every term also on its own."""

from __future__ import annotations

from functools import reduce

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.keys import EGO_INDEX
from ganlane.settings.observation import RewardParameters
from ganlane.transforms.base import StateTransform


def speed_reward(
    speed: Tensor,
    desired_speed: Tensor,
    mean_acceleration: Tensor,
    p: RewardParameters,
) -> Tensor:
    """``(v - 15) / (v_des - 15)``, or its negation where the ego braked hard.

    Hard is what is below ``low_acceleration`` on average over the decision.

    Args:
        speed, desired_speed: of the ego, m/s.
        mean_acceleration: over the decision, m/s2.
        p: the base speed (the 15 m/s of the formula), and what counts as braking hard.
    """
    reward = (speed - p.base_speed_mps) / (desired_speed - p.base_speed_mps)

    # The paper negates the reward, which below the base speed would pay for hard braking.
    punished = -reward if p.literal_low_acceleration else -reward.abs()
    braked_hard = mean_acceleration < p.low_acceleration
    return torch.where(braked_hard, punished, reward)


class RewardTransform(StateTransform):
    """Write ``reward`` [N, 1] and ``reward_terms.*`` [N, 1], on the speed at a decision's end.

    Args:
        decision_period_s: factor of the terms that accrue with time, s.
        parameters: section V.C; a ``soft_crash_behind`` other than 0 adds a term of that name.
    """

    def __init__(
        self, decision_period_s: float = 1.0, parameters: RewardParameters | None = None
    ) -> None:
        super().__init__(
            in_keys=[keys.VEHICLES, keys.EGO, keys.EVENTS],
            out_keys=[keys.REWARD, keys.REWARD_TERMS],
        )
        self.period = decision_period_s
        self.parameters = parameters or RewardParameters()

    def terms(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """Name to reward term [N, 1] of the decision that led to the state in ``tensordict``."""
        p = self.parameters
        vehicles = tensordict.get(keys.VEHICLES)
        ego = tensordict.get(keys.EGO)
        events = tensordict.get(keys.EVENTS)

        # Columns [N, 1].
        speed = vehicles.get("speed")[:, EGO_INDEX, None]
        desired = vehicles.get("desired_speed")[:, EGO_INDEX, None]
        acceleration = ego.get("mean_acceleration")[:, None]
        started = ego.get("started_change")[:, None]

        terms = {"speed": self.period * speed_reward(speed, desired, acceleration, p)}
        # Every other term is a price times how often its event happened in the decision. They are
        # added up in the order of term_names, which floating-point sums depend on.
        for name in p.term_names[1:]:
            # A lane change is no event: the ego remembers whether it has started one.
            count = started if name == "lane_change" else events.get(name)
            terms[name] = getattr(p, name) * count.to(speed.dtype)
        return terms

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        # Terms for tables and logs, their sum for the agent.
        terms = self.terms(next_tensordict)
        _write_terms(next_tensordict, terms)
        return next_tensordict.set(keys.REWARD, reduce(torch.add, terms.values()))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # A reset has driven nothing, yet its keys must be those of a step.
        vehicles = tensordict_reset.get(keys.VEHICLES)
        zero = torch.zeros_like(vehicles.get("x")[:, :1])
        return _write_terms(tensordict_reset, dict.fromkeys(self.parameters.term_names, zero))


def _write_terms(state: TensorDictBase, terms: dict[str, Tensor]) -> TensorDictBase:
    """``state`` with ``terms`` [N, 1] nested in it."""
    nested = TensorDict._new_unsafe(terms, batch_size=state.batch_size)
    return state.set(keys.REWARD_TERMS, nested)
