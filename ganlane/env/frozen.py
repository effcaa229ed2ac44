"""The traffic's memory of rows that end within a decision: it stays as it was when they ended."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor


class Frozen:
    """Memory of the rows that have ended, put aside until the decision is over.

    Meanwhile the traffic goes on remembering in these rows too, for nothing. To keep them as they are in every
    physics step would copy the memory of all rows so often; generated traffic's is large.
    """

    def __init__(self) -> None:
        self.rows: list[Tensor] = []
        self.memories: list[TensorDictBase] = []

    def note(self, ended: Tensor, memory: TensorDictBase) -> None:
        """Put aside the ``memory`` of the rows [N] that have just ``ended``."""
        if ended.any():
            rows = ended.nonzero()[:, 0]
            self.rows.append(rows)
            # TorchRL drops empty parts between decisions, so those of a first moment and of later ones would differ.
            self.memories.append(memory[rows].filter_empty_())

    def put_back(self, memory: TensorDictBase) -> TensorDictBase:
        """``memory`` with the rows that have ended as they were then; its tensors are not written to."""
        if not self.rows or memory.is_empty():
            return memory
        return _with_rows(memory, torch.cat(self.rows), torch.cat(self.memories))  # type: ignore[arg-type]


def _with_rows(memory: TensorDictBase, rows: Tensor, other: TensorDictBase) -> TensorDict:
    """``memory`` with its ``rows`` replaced by ``other`` [R], leaf by leaf."""

    def replaced(name: str, value: Tensor | TensorDictBase) -> Tensor | TensorDictBase:
        if isinstance(value, TensorDictBase):
            return value if value.is_empty() else _with_rows(value, rows, other.get(name))
        return value.index_copy(0, rows, other.get(name))

    kept = {name: replaced(name, value) for name, value in memory.items()}
    return TensorDict._new_unsafe(kept, batch_size=memory.batch_size)
