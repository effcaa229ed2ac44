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
#: Sums over the running episode of each environment; ``to_go`` sums the discounted returns from
#: each of its decisions on, ``values`` what the policy expected of them.
RUNNING = ("returns", "discounted", "to_go", "lengths", "values")


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
        """Add one step of the environments, batch [N]; the episodes that end are summed up."""
        after = step.get("next")
        reward = after.get("reward").squeeze(-1)
        done = after.get("done").squeeze(-1)
        running = self.running
        running["returns"] += reward
        running["discounted"] += self.discount * reward
        running["to_go"] += self.weight * reward
        running["lengths"] += 1.0
        chosen = step.get(keys.CHOSEN_VALUE, None)
        if chosen is not None:
            running["values"] += chosen.reshape(-1)
        self.discount *= self.gamma
        # The next reward counts fully for the next decision, gamma times as much for those before.
        self.weight = 1.0 + self.gamma * self.weight

        taken = step.get(keys.ACTION)[:, None] == self.actions
        self._add("actions", taken.sum(0))
        self._add("episodes", done.sum())
        at_end = dict(running)
        if chosen is None:
            del at_end["values"]
        events = after.get(keys.EVENTS, {})
        at_end |= {name: events.get(name).squeeze(-1) for name in RATES if name in events}
        ego = after.get(keys.EGO, None)
        if ego is not None:
            at_end |= {name: ego.get(name) for name in ("distance", "lane_changes")}
        for name, value in at_end.items():
            self._add(name, (value * done).sum())

        # episodes that have ended begin anew
        going = ~done
        for name, value in running.items():
            running[name] = value * going
        self.discount = torch.where(done, 1.0, self.discount)
        self.weight = torch.where(done, 1.0, self.weight)

    def update(self, metrics: Mapping[str, Tensor]) -> None:
        """Add the 0-dim ``metrics`` of one update."""
        # summed on the device, without waiting for it
        self.update_count += 1
        for name, value in metrics.items():
            self.updates[name] = self.updates.get(name, 0.0) + value

    def _add(self, name: str, value: Tensor) -> None:
        self.sums[name] = self.sums.get(name, 0.0) + value.double()

    def read(self) -> dict[str, float]:
        """Means since the last call; resets the sums.

        What would be a mean over no episode or no update is left out.
        """
        # one copy from the device for each sum, and none between two calls
        sums: dict[str, Any] = {name: value.tolist() for name, value in self.sums.items()}
        row = {name: float(value) / self.update_count for name, value in self.updates.items()}
        taken = sums.pop("actions", [])
        for i, count in enumerate(taken):
            row[f"action_{i}_share"] = count / max(sum(taken), 1)
        self.sums, self.updates, self.update_count = {}, {}, 0
        episodes = row["episodes"] = sums.get("episodes", 0.0)
        if episodes == 0.0:
            return row
        row["mean_return"] = sums["returns"] / episodes
        row["mean_discounted_return"] = sums["discounted"] / episodes
        decisions = max(sums["lengths"], 1.0)
        row["mean_return_to_go"] = sums["to_go"] / decisions
        if "values" in sums:
            row["mean_value"] = sums["values"] / decisions
        for name, column in RATES.items():
            if name in sums:
                row[column] = sums[name] / episodes
        if sums.get("distance", 0.0) > 0.0:
            row["lane_changes_per_km"] = 1000.0 * sums["lane_changes"] / sums["distance"]
        return row

    def state_dict(self) -> dict[str, Any]:
        """Sums of the running episodes and of the current interval."""
        names = ("running", "discount", "weight", "sums", "updates", "update_count")
        return {name: deepcopy(getattr(self, name)) for name in names}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        for name, value in state.items():
            setattr(self, name, deepcopy(value))
