"""The state of a run, from which everything else of it follows, and the checkpoint that resumes it."""

from __future__ import annotations

import mmap
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torchrl.envs import EnvBase

from ganlane.agents import Rainbow, save_agent
from ganlane.checksums import has_checksum, note_without_checksum, seal_archive
from ganlane.config.resume import LAST
from ganlane.errors import UserError
from ganlane.files import atomic_path
from ganlane.training.collectors import Collector, SingleCollector
from ganlane.training.parts import check_parts
from ganlane.training.stats import EpisodeStats

KIND = "ganlane training checkpoint"
VERSION = 2
#: Names in the checkpoints of version 0.1, and today's.
RENAMED = {"carrier": "env_state", "meter": "stats", "owed": "pending_decisions"}
#: Key of an identity for the defaults of its options.
DEFAULTS = "defaults"
#: Parts of an identity that may change when a run is resumed, bit-exact only if they do not: how it is computed.
COMPUTED_BY = ("env.compile",)
#: A checkpoint that took t seconds to write is followed by the next after 50 t at the earliest: 2 % of the time.
PATIENCE = 50.0
#: Parts of a checkpoint whose numbers are always finite.
FINITE = ("network", "target", "optimizer", "replay", "window", "stats")


class TrainingState:
    """State of a run of ``agent`` in ``env``, batch [N].

    ``pending_decisions`` are not yet paid for by an update; ``best`` is the best evaluation so far, ``evaluated_at``
    the decisions at the last one. ``identity`` is plain data that a resumed run must share: environment, traffic,
    reward, seed; under :data:`DEFAULTS`, which is not saved, the defaults of its options by dotted name, for the
    options that an older run does not name.
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
        """Seconds of training, earlier stretches included."""
        return self._before_s + time.monotonic() - self._started_s

    def passed(self, every: int) -> bool:
        """Whether the last step passed a multiple of ``every`` decisions; never, for 0."""
        return every > 0 and self.decisions // every > (self.decisions - self.environments) // every

    def state_dict(self, with_replay: bool = True) -> dict[str, Any]:
        """Tensors and plain data.

        Without the replay buffer it is small, and of the environments only the episodes are kept: a resumed run
        starts the next ones, and is not bit-exact. So it is with a collector that cannot be resumed exactly.
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
        """Go on from the checkpoint of a run with as many environments and the same agent.

        Returns:
            None where the rest of the run is the one it would have been, else what it has to do without.

        Raises:
            UserError: unreadable, or of another run.
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
        except Exception as error:  # what a part can be instead of what it was has no end
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise UserError(
                f"resume={path}: a part of the run is damaged in it ({reason}); give another checkpoint."
            ) from error
        return missing

    def _take_over(self, state: Mapping[str, Any], path: str | Path) -> str | None:
        """Everything from ``state``; see :meth:`restore`."""
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
        """Raise :class:`UserError` where the run with identity ``saved`` is not this one."""
        theirs, ours = (flat({**self.defaults, **flat(one)}) for one in (saved, self.identity))
        for name in (*ours, *theirs):
            if name not in COMPUTED_BY and theirs.get(name) != ours.get(name):
                raise UserError(
                    f"resume={path}: {name}={ours.get(name)}, but the run was started with {theirs.get(name)}; "
                    "go on with that, or start a new run."
                )


class Checkpointer:
    """Writes ``checkpoints/last.pt`` (to resume), ``last.safetensors`` and ``best.safetensors`` (to drive).

    Args:
        state: to be saved.
        folder: of the run.
        every_s: seconds between two checkpoints, at least.
        with_replay: whether they hold the replay buffer.
        metadata: goes into the agent's files; what is known of the training is added under ``training``.
    """

    def __init__(
        self, state: TrainingState, folder: str | Path, every_s: float, with_replay: bool, metadata: Mapping[str, Any]
    ) -> None:
        self.state, self.path, self.metadata = state, Path(folder) / LAST, metadata
        self.every_s, self.with_replay = every_s, with_replay
        self.saved_s, self.pause_s = time.monotonic(), every_s

    def due(self) -> bool:
        """Whether it is time for the next checkpoint."""
        return time.monotonic() - self.saved_s > self.pause_s

    def save(self) -> None:
        """Write the checkpoint and the present weights."""
        begun = time.monotonic()
        save_checkpoint(self.path, self.state.state_dict(self.with_replay))
        self.save_weights("last", {})
        self.saved_s = time.monotonic()
        self.pause_s = max(self.every_s, PATIENCE * (self.saved_s - begun))

    def save_weights(self, name: str, figures: Mapping[str, Any]) -> None:
        """Write the online network as ``NAME.safetensors``, with ``figures`` in its metadata."""
        state = self.state
        known = {"decisions": state.decisions, "updates": state.agent.updates, "wall_s": state.wall_s}
        training = {**self.metadata.get("training", {}), **known, **figures}
        save_agent(self.path.with_name(f"{name}.safetensors"), state.agent, {**self.metadata, "training": training})


def save_checkpoint(path: str | Path, state: Any) -> None:
    """Write ``state`` (tensors and plain data) atomically, with a checksum of the whole file."""
    with atomic_path(path) as part:
        torch.save({"kind": KIND, "version": VERSION, "sealed": True, "state": state}, part)
        seal_archive(part)


def load_checkpoint(path: str | Path, device: torch.device | str = "cpu", key: str = "resume") -> Any:
    """Read what :func:`save_checkpoint` wrote, under today's names; never executes code.

    A file of a version that wrote no checksum is read, too (:func:`note_without_checksum`).

    Args:
        path: of the file.
        device: for its tensors.
        key: of the command line that gave ``path``.

    Raises:
        UserError: absent, damaged in any byte, with weights that are not finite, or no training checkpoint of this
            version.
    """
    path, given = Path(path), f"{key}={path}"
    if not path.is_file():
        raise UserError(f"{given}: no such file; give a run's folder or its {LAST}.")
    with path.open("rb") as file:
        empty = file.seek(0, 2) == 0
        whole = not empty and has_checksum(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ), given)
    try:
        content = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # foreign bytes can make the unpickler fail in any way
        raise UserError(
            f"{given}: not a readable checkpoint (truncated, or not written by ganlane); give another one."
        ) from error
    if not isinstance(content, dict) or content.get("kind") != KIND or content.get("version") != VERSION:
        raise UserError(f"{given}: not a {KIND} of version {VERSION}; give a run's {LAST}.")
    if not whole and "sealed" in content:
        raise UserError(f"{given}: damaged, the checksum that was written with it is missing; give another one.")
    state = _renamed(content.get("state"))  # whether a run can go on from it, the run knows
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
    """Nested plain data as dotted names; tuples as lists, which is how they come back from a file."""
    names: dict[str, Any] = {}
    for name, value in nested.items():
        if isinstance(value, Mapping) and value:
            names |= flat(value, f"{above}{name}.")
        else:
            names[f"{above}{name}"] = list(value) if isinstance(value, tuple) else value
    return names
