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
        self.returns, self.discounted, self.to_go, self.lengths, self.values = (
            torch.zeros(environments, device=device) for _ in RUNNING
        )
        self.discount = torch.ones(environments, device=device)
        #: Discounted weight of the next reward in the returns to go of all decisions of the episode
        #: so far.
        self.weight = torch.ones(environments, device=device)
        self.actions = torch.arange(actions, device=device)
        self.sums: dict[str, Tensor] = {}
        self.updates: dict[str, Tensor] = {}
        self.update_count = 0

    @torch.no_grad()
    def step(self, step: TensorDictBase) -> None:
        """Add one step of the environments, batch [N]; the episodes that end are summed up."""
        after = step.get("next")
        reward, done = after.get("reward").squeeze(-1), after.get("done").squeeze(-1)
        self.returns += reward
        self.discounted += self.discount * reward
        self.discount *= self.gamma
        self.to_go += self.weight * reward
        self.weight = 1.0 + self.gamma * self.weight
        self.lengths += 1.0
        chosen = step.get(keys.CHOSEN_VALUE, None)
        if chosen is not None:
            self.values += chosen.reshape(-1)
        self._add("actions", (step.get(keys.ACTION)[:, None] == self.actions).sum(0))
        self._add("episodes", done.sum())
        for name in RUNNING if chosen is not None else RUNNING[:-1]:
            self._add(name, (getattr(self, name) * done).sum())
        events, ego = after.get(keys.EVENTS, {}), after.get(keys.EGO, None)
        for name in RATES.keys() & events.keys():
            self._add(name, (events.get(name).squeeze(-1) & done).sum())
        if ego is not None:
            for name in ("distance", "lane_changes"):
                self._add(name, (ego.get(name) * done).sum())
        going = ~done
        for name in RUNNING:
            setattr(self, name, getattr(self, name) * going)
        self.discount, self.weight = (
            torch.where(done, 1.0, value) for value in (self.discount, self.weight)
        )

    def update(self, metrics: Mapping[str, Tensor]) -> None:
        """Add the 0-dim ``metrics`` of one update."""
        self.update_count += 1
        for name, value in metrics.items():
            self.updates[name] = self.updates.get(name, 0.0) + value

    def _add(self, name: str, value: Tensor) -> None:
        self.sums[name] = self.sums.get(name, 0.0) + value.double()

    def read(self) -> dict[str, float]:
        """Means since the last call, without those over no episode or no update; resets the sums."""
        sums: dict[str, Any] = {name: value.tolist() for name, value in self.sums.items()}
        row = {name: float(value) / self.update_count for name, value in self.updates.items()}
        shares = sums.pop("actions", [])
        row |= {f"action_{i}_share": share / max(sum(shares), 1) for i, share in enumerate(shares)}
        self.sums, self.updates, self.update_count = {}, {}, 0
        episodes = sums.get("episodes", 0.0)
        row["episodes"] = episodes
        if episodes == 0.0:
            return row
        row |= {
            "mean_return": sums["returns"] / episodes,
            "mean_discounted_return": sums["discounted"] / episodes,
        }
        decisions = max(sums["lengths"], 1.0)
        row["mean_return_to_go"] = sums["to_go"] / decisions
        if "values" in sums:
            row["mean_value"] = sums["values"] / decisions
        row |= {column: sums[name] / episodes for name, column in RATES.items() if name in sums}
        if sums.get("distance", 0.0) > 0.0:
            row["lane_changes_per_km"] = 1000.0 * sums["lane_changes"] / sums["distance"]
        return row

    def state_dict(self) -> dict[str, Any]:
        """Sums of the running episodes and of the current interval."""
        names = (*RUNNING, "discount", "weight", "sums", "updates", "update_count")
        return {name: deepcopy(getattr(self, name)) for name in names}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        for name, value in state.items():
            setattr(self, name, deepcopy(value))
