"""The complete state of a training run, and the checkpoint that resumes it."""

from __future__ import annotations

import mmap
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from ganlane.agents import NStepWindow, Rainbow, save_agent
from ganlane.config.run import LAST
from ganlane.errors import UserError
from ganlane.evaluation.results import flat
from ganlane.files import atomic_path, has_checksum, refuse_without_checksum, seal_archive
from ganlane.settings.train import TrainConfig
from ganlane.training.collectors import Collector
from ganlane.training.stats import EpisodeStats

KIND = "ganlane training checkpoint"
VERSION = 2
#: After a checkpoint that took t seconds the next comes after 50 t or later: 2 % of the time.
PATIENCE = 50.0
#: What a checkpoint consists of.
PARTS = ("agent", "window", "env_state", "stats", "counters", "identity")
#: Those in which every number must be finite.
FINITE = ("agent", "window", "stats")


class TrainingState:
    """State of a run.

    Args:
        env: batch [N].
        agent: that is trained in it.
        identity: plain data that a resumed run must share: environment, traffic, reward, seed.

    Attributes:
        environments: N.
        decisions: made so far, over all environments.
        pending_decisions: those of them whose updates are still due.
        evaluated_at: decisions at the last evaluation.
        best: mean reward of the best evaluation so far; None before the first.
    """

    def __init__(
        self, env: EnvBase, agent: Rainbow, identity: Mapping[str, Any] | None = None
    ) -> None:
        self.identity = dict(identity or {})

        # What the run consists of, in the order of a decision.
        self.collector = Collector(env)
        self.agent = agent
        gamma = agent.config.gamma
        self.window = NStepWindow(agent.config.n_step, gamma)
        self.environments = self.collector.environments
        actions = agent.network.config.actions
        self.stats = EpisodeStats(self.environments, actions, gamma, agent.device)

        self.decisions = 0
        self.pending_decisions = 0
        self.evaluated_at = 0
        self.best: float | None = None

        # Wall time of the run before it was resumed.
        self._before_s = 0.0
        self._started_s = time.monotonic()

    @property
    def wall_s(self) -> float:
        """Seconds of training, including those before the run was resumed."""
        return self._before_s + time.monotonic() - self._started_s

    def progress(self) -> dict[str, Any]:
        """How far the run has come."""
        return {
            "decisions": self.decisions,
            "updates": self.agent.updates,
            "wall_s": self.wall_s,
        }

    def passed(self, every: int) -> bool:
        """Whether the last step passed a multiple of ``every`` decisions; never, for 0."""
        if every <= 0:
            return False
        # A step makes N decisions at once, so multiples are passed rather than met.
        before = self.decisions - self.environments
        return self.decisions // every > before // every

    def state_dict(self, with_replay: bool = True) -> dict[str, Any]:
        """Tensors and plain data.

        Without the replay buffer the state is small and holds only the episode numbers of the
        environments: a resumed run starts the next episodes and is not bit-exact.
        """
        return {
            "agent": self.agent.state_dict(with_replay),
            # None marks what a light checkpoint leaves out.
            "window": self.window.state_dict() if with_replay else None,
            "env_state": self.collector.state_dict(with_replay),
            "stats": self.stats.state_dict() if with_replay else None,
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
        option = f"resume={path}"
        state = load_checkpoint(path, self.agent.device)
        if not isinstance(state, dict) or not state.keys() >= {*PARTS}:
            raise UserError(
                f"{option}: parts of the run are missing in it; give another checkpoint."
            )
        for name in FINITE:
            if not _finite(state[name]):
                raise UserError(
                    f"{option}: numbers of its {name} are not finite; give a checkpoint of "
                    "another run."
                )

        try:
            self._take_over(state, option)
        except UserError:
            raise
        except Exception as error:  # damaged parts can fail in any way
            # On one line, whatever the error says.
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise UserError(
                f"{option}: a part of the run is damaged in it ({reason}); give another checkpoint."
            ) from error

        if state["agent"]["replay"] is None:
            return "the replay buffer: it is filled again before the next update"
        return None

    def _take_over(self, state: Mapping[str, Any], option: str) -> None:
        """Restore everything from ``state``; see :meth:`restore`."""
        # By dotted name, as on the command line.
        before = flat(state["identity"])
        now = flat(self.identity)
        # The first difference is enough for a sentence.
        for name in (*now, *before):
            if before.get(name) != now.get(name):
                raise UserError(
                    f"{option}: {name}={now.get(name)}, but the run was started with "
                    f"{before.get(name)}; go on with that, or start a new run."
                )
        shape = state["env_state"]["batch_size"]
        if shape != [self.environments]:
            raise UserError(
                f"{option}: saved with environments of shape {shape}, this run has "
                f"[{self.environments}]; use the same number."
            )

        self.agent.load_state_dict(state["agent"])
        # With the window and the buffer everything goes on where it stopped.
        exact = state["window"] is not None
        self.collector.load_state_dict(state["env_state"], exact)
        if exact:
            self.window.load_state_dict(state["window"])
            self.stats.load_state_dict(state["stats"])

        counters = state["counters"]
        self.decisions = counters["decisions"]
        self.pending_decisions = counters["pending_decisions"]
        self.best = counters["best"]
        self._before_s = counters["wall_s"]


class Checkpointer:
    """Writes ``checkpoints/last.pt`` (to resume), ``last`` and ``best.safetensors`` (to drive).

    Args:
        state: of the run.
        folder: of the run.
        config: says how often, and whether with the replay buffer.
        metadata: of the agent's files; the progress of the training is added, under ``training``.
    """

    def __init__(
        self,
        state: TrainingState,
        folder: str | Path,
        config: TrainConfig,
        metadata: Mapping[str, Any],
    ) -> None:
        self.state = state
        self.path = Path(folder) / LAST
        self.config = config
        self.metadata = metadata
        self.next_s = time.monotonic() + config.checkpoint_every_s

    def due(self) -> bool:
        """Whether the next checkpoint is due."""
        return time.monotonic() > self.next_s

    def save(self) -> None:
        """Write the checkpoint and the current weights."""
        begun = time.monotonic()
        save_checkpoint(self.path, self.state.state_dict(self.config.checkpoint_replay))
        # Weights alone, as an agent's file: it can be driven while the training goes on.
        self.save_weights("last", {})
        now = time.monotonic()
        took_s = now - begun
        # A slow disk must not slow down the training.
        self.next_s = now + max(self.config.checkpoint_every_s, PATIENCE * took_s)

    def save_weights(self, name: str, figures: Mapping[str, Any]) -> None:
        """Write the online network as ``NAME.safetensors``, with ``figures`` in its metadata."""
        training = {
            **self.metadata.get("training", {}),
            **self.state.progress(),
            **figures,
        }
        metadata = {**self.metadata, "training": training}
        save_agent(self.path.with_name(f"{name}.safetensors"), self.state.agent, metadata)


def save_checkpoint(path: str | Path, state: Any) -> None:
    """Write ``state`` (tensors and plain data) atomically, with a checksum of the whole file."""
    # A kill while writing leaves the checkpoint before it.
    with atomic_path(path) as part:
        torch.save({"kind": KIND, "version": VERSION, "state": state}, part)
        # The checksum goes into the comment of the archive, which torch does not read.
        seal_archive(part)


def load_checkpoint(path: str | Path, device: torch.device | str = "cpu") -> Any:
    """Read a file of :func:`save_checkpoint`; never executes code.

    Raises:
        UserError: the file is absent, damaged in any byte, or is no training checkpoint of this
            version.
    """
    path = Path(path)
    option = f"resume={path}"
    if not path.is_file():
        raise UserError(f"{option}: no such file; give a run's folder or its {LAST}.")

    sealed = False
    with path.open("rb") as file:
        # Another file, however large, is not searched for a checksum; an empty one has no map.
        if file.read(2) == b"PK":
            archive = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            sealed = has_checksum(archive, option)
    try:
        # weights_only: no pickled object is made, no code runs.
        content = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # arbitrary bytes can make the unpickler fail in any way
        raise UserError(
            f"{option}: not a readable checkpoint (truncated, or not written by ganlane); give "
            "another one."
        ) from error

    # First the kind: a file of another program has no checksum of ours either.
    header = content if isinstance(content, dict) else {}
    if (header.get("kind"), header.get("version")) != (KIND, VERSION):
        raise UserError(f"{option}: not a {KIND} of version {VERSION}; give a run's {LAST}.")
    if not sealed:
        refuse_without_checksum(option)
    return header.get("state")  # :meth:`TrainingState.restore` checks the parts


def _finite(state: Any) -> bool:
    """Whether all numbers in the tensors of nested plain data are finite."""
    if isinstance(state, Tensor):
        return bool(state.isfinite().all())
    if isinstance(state, dict):
        return all(map(_finite, state.values()))
    return not isinstance(state, list | tuple) or all(map(_finite, state))
