"""TorchRL's replay buffer, with prioritised or uniform sampling from a generator of its own.

TorchRL's prioritised sampler needs a C++ extension that loads only with the one torch release it
was built for. :class:`RowSampler` (Schaul et al. 2016) works on plain tensors instead, and is as
fast at a capacity of a million.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import (
    LazyTensorStorage,
    PrioritizedSampler,
    RandomSampler,
    TensorDictReplayBuffer,
)
from torchrl.data.replay_buffers.storages import Storage

from ganlane.errors import UserError
from ganlane.settings.agent import RainbowConfig

#: What a transition consists of; everything else is dropped before storing.
TRANSITION_KEYS = (
    "observation",
    "action",
    "steps_to_next_obs",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "terminated"),
    # where the environment has a mask
    ("next", "action_mask"),
)
#: Priorities per row: a sum tree of two levels, the lower one 64 wide.
ROW = 64


def make_replay(config: RainbowConfig, generator: torch.Generator) -> TensorDictReplayBuffer:
    """The replay buffer that ``config`` asks for, on the generator's device.

    All that it draws comes from ``generator``.
    """
    device = generator.device
    sampler = RandomSampler()
    if config.prioritised:
        sampler = RowSampler(config.capacity, config.alpha, config.beta_start, device)
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(config.capacity, device=device),
        sampler=sampler,
        batch_size=config.batch_size,
        generator=generator,
        priority_key="td_error",
    )


def replay_state(buffer: TensorDictReplayBuffer) -> dict[str, Any]:
    """Plain data: the transitions in use (by dotted key), the place of the next, the sampler."""
    # In the order of the storage, so that the indices of the sampler hold.
    rows = buffer[:] if len(buffer) else TensorDict({}, [0])
    # The mask of the next actions may be missing.
    rows = rows.select(*TRANSITION_KEYS, strict=False)
    tensors = dict(rows.flatten_keys(".").items())

    # A view would be saved with all of the storage behind it.
    if len(buffer) < buffer.storage.max_size:
        tensors = {name: tensor.clone() for name, tensor in tensors.items()}

    return {
        "rows": tensors,
        "cursor": buffer.writer._cursor,
        "writes": buffer.write_count,
        "sampler": buffer.sampler.state_dict(),
    }


def load_replay_state(buffer: TensorDictReplayBuffer, state: dict[str, Any]) -> None:
    """Restore :func:`replay_state` into a buffer of the same capacity."""
    buffer.empty()
    tensors = state["rows"]
    if tensors:
        rows = TensorDict(tensors, [len(tensors["action"])])
        buffer.extend(rows.unflatten_keys("."))

    # extend() has moved the cursor to the end of the rows; once the buffer has been full, it
    # stands anywhere among them.
    buffer.writer._cursor = state["cursor"]
    buffer.writer._write_count = state["writes"]
    buffer.sampler.load_state_dict(state["sampler"])


class RowSampler(PrioritizedSampler):
    """Draws item i with probability ``(p_i + 1e-8)^alpha / sum``.

    Its weight is ``(P_i N)^-beta`` over the batch's largest.
    As in Dopamine, the largest weight is the batch's: the one of the whole buffer belongs to an
    outlier that is hardly ever drawn, and would shrink every step. New items get the largest
    priority seen. Draws come from the generator of the replay buffer (``generator=`` at its
    construction) and from no other.

    Priorities lie in rows of :data:`ROW`, whose sums are kept: a draw looks for a row by these
    sums, and then for an item in the row, instead of summing up all priorities.

    Args:
        max_capacity: of the buffer.
        alpha: exponent of the priorities.
        beta: exponent of the weights; the agent anneals it.
        device: of the priorities.
    """

    def __init__(self, max_capacity: int, alpha: float, beta: float, device: torch.device) -> None:
        # Not the parent's constructor: it warns of a missing C++ extension, not needed here. These
        # are the attributes that the parent's methods read.
        self._max_capacity = max_capacity
        self._alpha = alpha
        self._beta = beta
        self._eps = 1e-8
        self._device = device
        self.dtype = torch.float32
        self.reduction = "max"
        self._max_priority_within_buffer = False
        self._init()

    def _init(self) -> None:
        # Rounded up.
        rows = -(-self._max_capacity // ROW)
        # ``(p_i + 1e-8)^alpha`` of every item; 0 where there is none.
        self.priorities = torch.zeros(rows, ROW, device=self._device)
        self.row_sums = torch.zeros(rows, dtype=torch.float64, device=self._device)
        # The largest p_i seen, at least 1.
        self.largest = torch.ones((), device=self._device)

    @property
    def device(self) -> torch.device:
        """Where the priorities are kept."""
        return self.priorities.device

    @property
    def default_priority(self) -> Tensor:
        """Raw priority of a new item, 0-dim: the largest seen, at least 1."""
        return self.largest

    @torch.no_grad()
    def update_priority(
        self, index: Tensor | int, priority: Tensor | float, *, storage: Storage | None = None
    ) -> None:
        """Give items new priorities.

        Args:
            index: of the items, [B].
            priority: raw, at least 0: [B], [B, 1] or a number for all.
            storage: not read; TorchRL passes it.
        """
        index = torch.as_tensor(index, device=self.device).reshape(-1)
        priority = torch.as_tensor(priority, dtype=torch.float32, device=self.device).reshape(-1)
        self.largest = torch.maximum(self.largest, priority.amax())
        raised = (priority + self._eps) ** self._alpha
        self.priorities.view(-1)[index] = raised.expand(index.shape)

        # Whole rows are summed anew, so that rounding errors do not add up.
        row = index // ROW
        self.row_sums[row] = self.priorities[row].sum(-1, dtype=torch.float64)

    @torch.no_grad()
    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Indices [B] and ``priority_weight`` [B], in (0, 1].

        Raises:
            UserError: a priority is not finite (checked on a CPU only).
        """
        # In double precision, since the sums run over all priorities.
        cumulated = self.row_sums.cumsum(0)
        total = cumulated[-1]
        # Reading it would make a GPU wait.
        if total.device.type == "cpu" and not total.isfinite():
            raise UserError(
                "training has diverged: its errors are not finite; lower agent.learning_rate and "
                "start again, or go on from an earlier checkpoint."
            )
        uniform = torch.rand(
            batch_size,
            generator=self._rng,
            dtype=torch.float64,
            device=self.device,
        )

        # First the row in which the drawn mass lies.
        mass = _below(uniform * total, total)
        row = torch.searchsorted(cumulated, mass, right=True)

        # Then the item within it, by the mass that is left after the rows before.
        before = cumulated[row] - self.row_sums[row]
        within = self.priorities[row].double().cumsum(-1)
        rest = _below(mass - before, within[:, -1])
        column = (within <= rest[:, None]).sum(-1)
        index = row * ROW + column

        # The item with the smallest priority has the largest weight, which becomes 1.
        chosen = self.priorities.view(-1)[index]
        weight = (chosen / chosen.amin()) ** -self._beta
        return index, {"priority_weight": weight}

    def state_dict(self) -> dict[str, Any]:
        """Priorities of the rows in use, the largest priority, and beta."""
        # Rows fill up from the first on.
        used = int((self.row_sums > 0).sum())
        return {
            "priorities": self.priorities[:used].clone(),
            "largest": self.largest.clone(),
            "beta": self._beta,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self._init()
        used = state_dict["priorities"].shape[0]
        self.priorities[:used] = state_dict["priorities"].to(self.device)
        self.row_sums[:] = self.priorities.sum(-1, dtype=torch.float64)
        self.largest = state_dict["largest"].to(self.device)
        self._beta = state_dict["beta"]


def _below(value: Tensor, bound: Tensor) -> Tensor:
    """``value`` held strictly below ``bound``: rounding must not select past the last item."""
    largest = torch.nextafter(bound, torch.zeros_like(bound))
    return torch.minimum(value, largest).clamp_min(0.0)
