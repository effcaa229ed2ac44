"""The complete state of a training run, and the checkpoint that resumes it."""

from __future__ import annotations

import mmap
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torchrl.envs import EnvBase

from ganlane.agents import Rainbow, save_agent
from ganlane.config.runs import LAST
from ganlane.errors import UserError
from ganlane.files import atomic_path, has_checksum, note_without_checksum, seal_archive
from ganlane.training.collectors import Collector, SingleCollector
from ganlane.training.parts import check_parts
from ganlane.training.stats import EpisodeStats

KIND = "ganlane training checkpoint"
VERSION = 2
#: Names in checkpoints of version 0.1, and their present names.
RENAMED = {"carrier": "env_state", "meter": "stats", "owed": "pending_decisions"}
#: Key of an identity that holds the defaults of its options.
DEFAULTS = "defaults"
#: Parts of an identity that may change when a run is resumed; the run is bit-exact only if they do not.
COMPUTED_BY = ("env.compile",)
#: After a checkpoint that took t seconds to write, the next comes after 50 t at the earliest: 2 % of the time.
PATIENCE = 50.0
#: Parts of a checkpoint in which every number must be finite.
FINITE = ("network", "target", "optimizer", "replay", "window", "stats")


class TrainingState:
    """State of a run of ``agent`` in ``env``, batch [N].

    ``pending_decisions`` counts decisions whose updates are still due; ``best`` is the best evaluation so far,
    ``evaluated_at`` the decisions at the last one. ``identity`` is plain data that a resumed run must share:
    environment, traffic, reward, seed. Its entry :data:`DEFAULTS`, which is not saved, holds the defaults of options
    by dotted name, for options that did not exist when an older run was started.
    """

    def __init__(self, env: EnvBase | Collector, agent: Rainbow, identity: Mapping[str, Any] | None = None) -> None:
        self.collector = env if isinstance(env, Collector) else SingleCollector(env)
        self.agent, self.identity = agent, dict(identity or {})
        self.defaults = self.identity.pop(DEFAULTS, {})
        self.environments = self.collector.environments
        self.window = agent.window()
        self.stats = EpisodeStats(self.environments, agent.network.config.actions, agent.config.gamma, agent.device)
        self.decisions, self.pending_decisions, self.evaluated_at = 0, 0, 0
        self.best: float | None = None
        self._before_s, self._started_s = 0.0, time.monotonic()

    @property
    def wall_s(self) -> float:
        """Seconds of training, including those before the run was resumed."""
        return self._before_s + time.monotonic() - self._started_s

    def passed(self, every: int) -> bool:
        """Whether the last step passed a multiple of ``every`` decisions; never, for 0."""
        return every > 0 and self.decisions // every > (self.decisions - self.environments) // every

    def state_dict(self, with_replay: bool = True) -> dict[str, Any]:
        """Tensors and plain data.

        Without the replay buffer the state is small and holds only the episode numbers of the environments: a
        resumed run starts the next episodes and is not bit-exact. The same holds for collectors that are not exact.
        """
        exact = with_replay and self.collector.exact
        return {
            "agent": self.agent.state_dict(with_replay),
            "window": self.window.state_dict() if exact else None,
            "env_state": self.collector.state_dict(exact),
            "stats": self.stats.state_dict() if exact else None,
            "counters": {
                "decisions": self.decisions,
                "pending_decisions": self.pending_decisions,
                "wall_s": self.wall_s,
                "best": self.best,
            },
            "identity": self.identity,
        }

    def restore(self, path: str | Path) -> str | None:
        """Load the checkpoint of a run with as many environments and the same agent.

        Returns:
            None if the run continues bit for bit, else what could not be restored.

        Raises:
            UserError: the checkpoint is unreadable, or of another run.
        """
        state = load_checkpoint(path, self.agent.device)
        parts = {"agent", "window", "env_state", "stats", "counters", "identity"}
        if not isinstance(state, dict) or not state.keys() >= parts:
            raise UserError(f"resume={path}: parts of the run are missing in it; give another checkpoint.")
        if not isinstance(state["identity"], dict):
            raise UserError(f"resume={path}: it does not say what run it is of; give another checkpoint.")
        self._refuse_another_run(path, state["identity"])
        try:
            missing = self._take_over(state, path)
        except UserError:
            raise
        except Exception as error:  # damaged parts can fail in any way
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise UserError(
                f"resume={path}: a part of the run is damaged in it ({reason}); give another checkpoint."
            ) from error
        return missing

    def _take_over(self, state: Mapping[str, Any], path: str | Path) -> str | None:
        """Restore everything from ``state``; see :meth:`restore`."""
        exact = state["window"] is not None
        fresh, shape = self.collector.state_dict(exact), state["env_state"]["batch_size"]
        if isinstance(shape, list) and shape != fresh["batch_size"]:
            raise UserError(
                f"resume={path}: saved with environments of shape {shape}, this run has [{self.environments}]; use "
                "the same number."
            )
        self.agent.load_state_dict(state["agent"])
        check_parts(state, self.agent, fresh, self.stats)
        self.collector.load_state_dict(state["env_state"], exact)
        if exact:
            self.window.load_state_dict(state["window"])
            self.stats.load_state_dict(state["stats"])
        counters = state["counters"]
        self.decisions, self.pending_decisions = counters["decisions"], counters["pending_decisions"]
        self.best, self._before_s = counters["best"], counters["wall_s"]
        if state["agent"]["replay"] is None:
            return "the replay buffer: it is filled again before the next update"
        return None if exact else "the episodes that were under way: the workers begin the next ones"

    def _refuse_another_run(self, path: str | Path, saved: Mapping[str, Any]) -> None:
        """Raise :class:`UserError` unless ``saved`` is the identity of this run."""
        before, now = (flat({**self.defaults, **flat(each)}) for each in (saved, self.identity))
        for name in (*now, *before):
            if name not in COMPUTED_BY and before.get(name) != now.get(name):
                raise UserError(
                    f"resume={path}: {name}={now.get(name)}, but the run was started with {before.get(name)}; "
                    "go on with that, or start a new run."
                )


class Checkpointer:
    """Writes ``checkpoints/last.pt`` (to resume), ``last.safetensors`` and ``best.safetensors`` (to drive).

    Args:
        state: to be saved.
        folder: of the run.
        every_s: least seconds between two checkpoints.
        with_replay: save the replay buffer too.
        metadata: for the agent's files; the progress of the training is added under ``training``.
    """

    def __init__(
        self, state: TrainingState, folder: str | Path, every_s: float, with_replay: bool, metadata: Mapping[str, Any]
    ) -> None:
        self.state, self.path, self.metadata = state, Path(folder) / LAST, metadata
        self.every_s, self.with_replay = every_s, with_replay
        self.saved_s, self.pause_s = time.monotonic(), every_s

    def due(self) -> bool:
        """Whether the next checkpoint is due."""
        return time.monotonic() - self.saved_s > self.pause_s

    def save(self) -> None:
        """Write the checkpoint and the current weights."""
        begun = time.monotonic()
        save_checkpoint(self.path, self.state.state_dict(self.with_replay))
        self.save_weights("last", {})
        self.saved_s = time.monotonic()
        self.pause_s = max(self.every_s, PATIENCE * (self.saved_s - begun))

    def save_weights(self, name: str, figures: Mapping[str, Any]) -> None:
        """Write the online network as ``NAME.safetensors``, with ``figures`` in its metadata."""
        state = self.state
        progress = {"decisions": state.decisions, "updates": state.agent.updates, "wall_s": state.wall_s}
        training = {**self.metadata.get("training", {}), **progress, **figures}
        save_agent(self.path.with_name(f"{name}.safetensors"), state.agent, {**self.metadata, "training": training})


def save_checkpoint(path: str | Path, state: Any) -> None:
    """Write ``state`` (tensors and plain data) atomically, with a checksum of the whole file."""
    with atomic_path(path) as part:
        torch.save({"kind": KIND, "version": VERSION, "sealed": True, "state": state}, part)
        seal_archive(part)


def load_checkpoint(path: str | Path, device: torch.device | str = "cpu", key: str = "resume") -> Any:
    """Read a file of :func:`save_checkpoint`, with present names; never executes code.

    Files of versions that wrote no checksum are read too (:func:`note_without_checksum`).

    Args:
        path: of the file.
        device: for its tensors.
        key: the configuration key of ``path``, for error messages.

    Raises:
        UserError: the file is absent, damaged in any byte, holds weights that are not finite, or is no training
            checkpoint of this version.
    """
    path, given = Path(path), f"{key}={path}"
    if not path.is_file():
        raise UserError(f"{given}: no such file; give a run's folder or its {LAST}.")
    with path.open("rb") as file:
        empty = file.seek(0, 2) == 0
        whole = not empty and has_checksum(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ), given)
    try:
        content = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # arbitrary bytes can make the unpickler fail in any way
        raise UserError(
            f"{given}: not a readable checkpoint (truncated, or not written by ganlane); give another one."
        ) from error
    if not isinstance(content, dict) or content.get("kind") != KIND or content.get("version") != VERSION:
        raise UserError(f"{given}: not a {KIND} of version {VERSION}; give a run's {LAST}.")
    if not whole and "sealed" in content:
        raise UserError(f"{given}: damaged, the checksum that was written with it is missing; give another one.")
    state = _renamed(content.get("state"))  # :meth:`TrainingState.restore` checks the parts
    if isinstance(state, dict) and "counters" in state:
        state["counters"] = _renamed(state["counters"])
    agent = state.get("agent") if isinstance(state, dict) else None
    parts = {**state, **agent} if isinstance(agent, dict) else {}
    for name in FINITE:
        if not all(tensor.isfinite().all() for tensor in _tensors(parts.get(name))):
            raise UserError(f"{given}: numbers of its {name} are not finite; give a checkpoint of another run.")
    if not whole:
        note_without_checksum(given)
    return state


def _tensors(state: Any) -> Iterator[torch.Tensor]:
    """All tensors in nested plain data."""
    if isinstance(state, torch.Tensor):
        yield state
    elif isinstance(state, dict | list | tuple):
        for value in state.values() if isinstance(state, dict) else state:
            yield from _tensors(value)


def _renamed(names: Any) -> Any:
    return {RENAMED.get(key, key): value for key, value in names.items()} if isinstance(names, dict) else names


def flat(nested: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Nested plain data by dotted name; tuples become lists, as when read from a file."""
    names: dict[str, Any] = {}
    for name, value in nested.items():
        if isinstance(value, Mapping) and value:
            names |= flat(value, f"{above}{name}.")
        else:
            names[f"{above}{name}"] = list(value) if isinstance(value, tuple) else value
    return names
