"""What is counted while episodes run: sums over decisions, and last values, of the rows still driving."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ganlane import keys

#: Summed over the decisions of an episode.
_SUMMED_EVENTS = (keys.SOFT_CRASH, keys.SOFT_CRASH_BEHIND)
#: Read at the episode's last decision.
_LAST_EGO = ("distance", "lane_changes", "decisions")


def _reward_terms(after: TensorDictBase) -> dict[str, Tensor]:
    """The reward's terms by column name; none where the reward does not report its terms."""
    terms = after.get(keys.REWARD_TERMS, None)
    return {} if terms is None else {f"reward_{name}": value for name, value in terms.items()}


def summed_measures(after: TensorDictBase) -> dict[str, Tensor]:
    """What one decision adds, each [N] float64, from the tensordict after the decision (``next``)."""
    events = after[keys.EVENTS]
    measures = {"reward": after[keys.REWARD], **_reward_terms(after)}
    measures |= {name: events[name] for name in _SUMMED_EVENTS}
    return {name: value.reshape(value.shape[0]).double() for name, value in measures.items()}


def last_measures(after: TensorDictBase) -> dict[str, Tensor]:
    """What stands at the end of a decision, each [N]: the ego's account, time in s, and the end events."""
    events = after[keys.EVENTS]
    measures = {name: after[keys.EGO, name] for name in _LAST_EGO}
    measures |= {"duration_s": after[keys.STEP].double() * keys.PHYSICS_STEP_S}
    measures |= {name: events[name].squeeze(-1) for name in keys.END_EVENTS}
    return measures


class EpisodeTally:
    """Sums and last values of N rows, of each until its first end; what a row does until it begins anew is ignored.

    :meth:`add` reads nothing back to the host, so it never waits for the device.

    Args:
        driving: [N] bool, the rows that count from the start.
    """

    def __init__(self, driving: Tensor):
        self.driving = driving.clone()
        self._sums: dict[str, Tensor] = {}
        self._last: dict[str, Tensor] = {}

    def add(self, after: TensorDictBase) -> None:
        """Count one decision, from the tensordict after it (``next``)."""
        driving = self.driving
        for name, value in summed_measures(after).items():
            counted = torch.where(driving, value, torch.zeros_like(value))
            self._sums[name] = self._sums[name] + counted if name in self._sums else counted
        for name, value in last_measures(after).items():
            before = self._last.get(name)
            self._last[name] = value.clone() if before is None else torch.where(driving, value, before)
        self.driving = driving & ~after["done"].squeeze(-1)

    def measures(self, rows: Tensor) -> dict[str, Tensor]:
        """All counts of ``rows`` [K] (int64) by name, each [K], on the CPU."""
        return {name: value[rows].cpu() for name, value in (self._sums | self._last).items()}

    def begin(self, rows: Tensor) -> None:
        """Count from 0 again in ``rows`` (int64), in which other episodes start."""
        self.driving[rows] = True
        for value in self._sums.values():
            value[rows] = 0.0

    def keep(self, rows: Tensor) -> None:
        """Go on with ``rows`` [K] (int64) alone, in that order."""
        self.driving = self.driving[rows]
        self._sums = {name: value[rows] for name, value in self._sums.items()}
        self._last = {name: value[rows] for name, value in self._last.items()}
