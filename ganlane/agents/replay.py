"""TorchRL's replay buffer, with prioritised or uniform sampling from its own generator."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, RandomSampler, TensorDictReplayBuffer

from ganlane.agents.sampler import RowSampler

#: What a transition consists of; everything else is dropped before storing.
TRANSITION_KEYS = (
    "observation",
    "action",
    "steps_to_next_obs",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "terminated"),
)
#: What it has besides where the environment has a mask.
MASK_KEY: tuple[str, ...] = ("next", "action_mask")


def make_replay(
    capacity: int,
    batch_size: int,
    generator: torch.Generator,
    prioritised: bool = True,
    alpha: float = 0.5,
    beta: float = 0.4,
) -> TensorDictReplayBuffer:
    """Replay buffer of ``capacity`` transitions on the generator's device; ``sample()`` draws ``batch_size``."""
    device = generator.device
    sampler = RowSampler(capacity, alpha, beta, device=device) if prioritised else RandomSampler()
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(capacity, device=device),
        sampler=sampler,
        batch_size=batch_size,
        generator=generator,
        priority_key="td_error",
    )


def annealed(start: float, end: float, done: int, total: int) -> float:
    """From ``start`` to ``end`` in a straight line over ``total``, then ``end``."""
    return end if done >= total else start + (end - start) * done / total


def replay_state(buffer: TensorDictReplayBuffer) -> dict[str, Any]:
    """The transitions in use (tensors by dotted key), the place of the next one, the sampler: plain data."""
    rows = buffer[:] if len(buffer) else TensorDict({}, [0])
    masked = rows.get(MASK_KEY, None) is not None
    stored = (*TRANSITION_KEYS, MASK_KEY) if masked else TRANSITION_KEYS
    tensors = {".".join(_path(key)): rows.get(key) for key in stored} if len(buffer) else {}
    if len(buffer) < buffer.storage.max_size:  # a view would be saved with all of the storage behind it
        tensors = {name: tensor.clone() for name, tensor in tensors.items()}
    state = {"rows": tensors, "cursor": buffer.writer._cursor, "sampler": buffer.sampler.state_dict()}
    return {**state, "writes": buffer.write_count}


def load_replay_state(buffer: TensorDictReplayBuffer, state: dict[str, Any]) -> None:
    """Restore :func:`replay_state` into a buffer of the same capacity."""
    buffer.empty()
    if state["rows"]:
        rows = {tuple(name.split(".")): tensor for name, tensor in state["rows"].items()}
        count = next(iter(rows.values())).shape[0]
        buffer.extend(TensorDict(rows, batch_size=[count]))
    buffer.writer._cursor = state["cursor"]
    buffer.writer._write_count = state["writes"]
    buffer.sampler.load_state_dict(state["sampler"])


def _path(key: str | tuple[str, ...]) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else key
