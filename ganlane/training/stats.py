"""Statistics of training episodes and updates, summed on the device and read only for logging."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ganlane import keys

#: Events at the end of an episode, and the column with the share of episodes that ended so.
RATES = {
    "goal": "goal_rate",
    "hard_crash": "crash_rate",
    "out_of_road": "out_of_road_rate",
    "timeout": "timeout_rate",
}
#: Sums over the running episode of each environment.
RUNNING = (
    "returns",
    # As seen from the first decision.
    "discounted",
    # The discounted returns from each of its decisions on, all of them together.
    "to_go",
    "lengths",
    # What the policy expected of these decisions.
    "values",
)
#: What :meth:`EpisodeStats.state_dict` holds.
_STATE = ("running", "discount", "weight", "sums", "updates", "update_count")


class EpisodeStats:
    """Statistics of the finished episodes and of the updates since the last :meth:`read`.

    Figures of keys that are not written (``events``, ``ego``, ``chosen_action_value``) are left
    out.

    **Q-values against realised returns.** ``mean_return_to_go`` is the discounted return from a
    decision to the end of its episode, averaged over all decisions of finished episodes;
    ``mean_value`` is the mean Q-value of the chosen actions at the same decisions. The two agree if
    the values are right (returns after a time limit count as 0).

    Args:
        environments: N.
        actions: A, for the shares of the actions.
        gamma: discount per decision.
        device: of the sums.

    Attributes:
        running: sums over the running episodes (:data:`RUNNING`), [N] each.
        sums: over the finished episodes since the last :meth:`read`, 0-dim; of ``actions`` [A].
        updates: sums over the updates since then, 0-dim, and ``update_count``, their number.
    """

    def __init__(
        self, environments: int, actions: int, gamma: float, device: torch.device | str = "cpu"
    ) -> None:
        self.gamma = gamma
        self.running = {name: torch.zeros(environments, device=device) for name in RUNNING}
        #: Discount of the next reward, seen from the start of the episode.
        self.discount = torch.ones(environments, device=device)
        #: Its weight in the returns to go of all decisions of the episode so far together.
        self.weight = torch.ones(environments, device=device)
        self.actions = torch.arange(actions, device=device)
        self.sums: dict[str, Tensor] = {}
        self.updates: dict[str, Tensor] = {}
        self.update_count = 0

    @torch.no_grad()
    def step(self, step: TensorDictBase) -> None:
        """Add one step of the environments, batch [N]; the episodes that end are summed up.

        Args:
            step: with ``action`` [N], and ``next`` with ``reward`` and ``done`` [N, 1]. Where they
                are written also ``chosen_action_value`` [N, 1], and of ``next`` ``events`` and
                ``ego``: these are totals of the episode so far.
        """
        after = step.get("next")
        reward = after.get("reward").squeeze(-1)
        done = after.get("done").squeeze(-1)
        chosen_value = step.get(keys.CHOSEN_VALUE, None)

        running = self.running
        running["returns"] += reward
        running["discounted"] += self.discount * reward
        running["to_go"] += self.weight * reward
        running["lengths"] += 1.0
        if chosen_value is not None:
            running["values"] += chosen_value.reshape(-1)
        self.discount *= self.gamma
        # The next reward counts fully for the next decision, gamma times as much for those before.
        self.weight = 1.0 + self.gamma * self.weight

        # [N, A]: which action each environment took.
        taken = step.get(keys.ACTION)[:, None] == self.actions
        self._add("actions", taken.sum(0))
        self._add("episodes", done.sum())

        # What counts only at the end of an episode: its sums, how it ended, how far it went.
        at_end = dict(running)
        if chosen_value is None:
            del at_end["values"]
        events = after.get(keys.EVENTS, {})
        for name in RATES:
            if name in events:
                at_end[name] = events.get(name).squeeze(-1)
        ego = after.get(keys.EGO, None)
        if ego is not None:
            at_end["distance"] = ego.get("distance")
            at_end["lane_changes"] = ego.get("lane_changes")
        for name, value in at_end.items():
            self._add(name, (value * done).sum())

        # Episodes that have ended begin anew.
        going = ~done
        for name, value in running.items():
            running[name] = value * going
        self.discount = torch.where(done, 1.0, self.discount)
        self.weight = torch.where(done, 1.0, self.weight)

    def update(self, metrics: Mapping[str, Tensor]) -> None:
        """Add the metrics of one update.

        Args:
            metrics: 0-dim tensors by name, on any device.
        """
        # Summed on the device, without waiting for it.
        self.update_count += 1
        for name, value in metrics.items():
            self.updates[name] = self.updates.get(name, 0.0) + value

    def _add(self, name: str, value: Tensor) -> None:
        """Add ``value`` to the sum of this name."""
        # In double precision: an interval may have millions of steps.
        self.sums[name] = self.sums.get(name, 0.0) + value.double()

    def read(self) -> dict[str, float]:
        """Means since the last call; resets the sums.

        Returns:
            Figures by their columns in ``metrics.csv``. What would be a mean over no episode or no
            update is left out.
        """
        # One copy from the device for each sum, and none between two calls.
        sums: dict[str, Any] = {name: value.tolist() for name, value in self.sums.items()}
        row = {name: float(value) / self.update_count for name, value in self.updates.items()}
        self.sums = {}
        self.updates = {}
        self.update_count = 0

        taken = sums.pop("actions", [])
        actions = max(sum(taken), 1)
        for i, count in enumerate(taken):
            row[f"action_{i}_share"] = count / actions

        episodes = sums.get("episodes", 0.0)
        row["episodes"] = episodes
        if episodes == 0.0:
            return row
        row["mean_return"] = sums["returns"] / episodes
        row["mean_discounted_return"] = sums["discounted"] / episodes

        # These two are means over decisions, so that they can be compared.
        decisions = max(sums["lengths"], 1.0)
        row["mean_return_to_go"] = sums["to_go"] / decisions
        if "values" in sums:
            row["mean_value"] = sums["values"] / decisions

        for name, column in RATES.items():
            if name in sums:
                row[column] = sums[name] / episodes
        if sums.get("distance", 0.0) > 0.0:
            # The distance is in metres.
            row["lane_changes_per_km"] = 1000.0 * sums["lane_changes"] / sums["distance"]
        return row

    def state_dict(self) -> dict[str, Any]:
        """Sums of the running episodes and of the current interval."""
        return {name: deepcopy(getattr(self, name)) for name in _STATE}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        for name, value in state.items():
            setattr(self, name, deepcopy(value))
