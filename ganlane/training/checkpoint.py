"""The complete state of a training run, and the checkpoint that resumes it."""

from __future__ import annotations

import mmap
import time
from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from ganlane import keys
from ganlane.agents import NetworkConfig, Rainbow, save_agent
from ganlane.agents.n_step import Step
from ganlane.agents.replay import MASK_KEY, ROW
from ganlane.config.run import LAST
from ganlane.errors import UserError
from ganlane.files import atomic_path, has_checksum, refuse_without_checksum, seal_archive
from ganlane.training.collectors import Collector
from ganlane.training.stats import EpisodeStats

KIND = "ganlane training checkpoint"
VERSION = 2
#: After a checkpoint that took t seconds the next comes after 50 t or later: 2 % of the time.
PATIENCE = 50.0
#: Parts of a checkpoint in which every number must be finite.
FINITE = (
    "network",
    "target",
    "optimizer",
    "replay",
    "window",
    "stats",
)
#: Upper bound of the decisions, updates and rows of a run.
MOST = 2**53
#: Name of the action masks in the rows of the replay buffer, if there are masks.
MASK = ".".join(MASK_KEY)


class TrainingState:
    """State of a run of ``agent`` in ``env``, batch [N].

    ``pending_decisions`` counts decisions whose updates are still due; ``best`` is the best
    evaluation so far, ``evaluated_at`` the decisions at the last one. ``identity`` is plain data
    that a resumed run must share: environment, traffic, reward, seed.
    """

    def __init__(
        self,
        env: EnvBase,
        agent: Rainbow,
        identity: Mapping[str, Any] | None = None,
    ) -> None:
        # what the run consists of, in the order of a decision
        self.collector = Collector(env)
        self.agent = agent
        self.identity = dict(identity or {})
        self.environments = self.collector.environments
        self.window = agent.window()
        self.stats = EpisodeStats(
            self.environments,
            agent.network.config.actions,
            agent.config.gamma,
            agent.device,
        )
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

    def passed(self, every: int) -> bool:
        """Whether the last step passed a multiple of ``every`` decisions; never, for 0."""
        # A step makes N decisions at once, so multiples are passed rather than met.
        return every > 0 and self.decisions // every > (self.decisions - self.environments) // every

    def state_dict(self, with_replay: bool = True) -> dict[str, Any]:
        """Tensors and plain data.

        Without the replay buffer the state is small and holds only the episode numbers of the
        environments: a resumed run starts the next episodes and is not bit-exact.
        """
        return {
            "agent": self.agent.state_dict(with_replay),
            # None marks what a light checkpoint leaves out
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
        state = load_checkpoint(path, self.agent.device)
        parts = {
            "agent",
            "window",
            "env_state",
            "stats",
            "counters",
            "identity",
        }
        if not isinstance(state, dict) or not state.keys() >= parts:
            raise UserError(
                f"resume={path}: parts of the run are missing in it; give another checkpoint."
            )
        if not isinstance(state["identity"], dict):
            raise UserError(
                f"resume={path}: it does not say what run it is of; give another checkpoint."
            )
        # by dotted name, as on the command line
        before = flat(state["identity"])
        now = flat(self.identity)
        # the first difference is enough for a sentence
        for name in (*now, *before):
            if before.get(name) != now.get(name):
                raise UserError(
                    f"resume={path}: {name}={now.get(name)}, but the run was started with "
                    f"{before.get(name)}; go on with that, or start a new run."
                )
        try:
            self._take_over(state, path)
        except UserError:
            raise
        except Exception as error:  # damaged parts can fail in any way
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise UserError(
                f"resume={path}: a part of the run is damaged in it ({reason}); give another "
                "checkpoint."
            ) from error
        if state["agent"]["replay"] is None:
            return "the replay buffer: it is filled again before the next update"
        return None

    def _take_over(self, state: Mapping[str, Any], path: str | Path) -> None:
        """Restore everything from ``state``; see :meth:`restore`."""
        # with the window and the buffer everything goes on where it stopped
        exact = state["window"] is not None
        fresh = self.collector.state_dict(exact)
        shape = state["env_state"]["batch_size"]
        if isinstance(shape, list) and shape != fresh["batch_size"]:
            raise UserError(
                f"resume={path}: saved with environments of shape {shape}, this run has "
                f"[{self.environments}]; use the same number."
            )
        # the agent first: the checks compare Adam's moments with its weights
        self.agent.load_state_dict(state["agent"])
        check_parts(
            state,
            self.agent,
            fresh,
            self.stats,
        )
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

    ``every_s`` are the least seconds between two checkpoints. To the ``metadata`` of the agent's
    files the progress of the training is added, under ``training``.
    """

    def __init__(
        self,
        state: TrainingState,
        folder: str | Path,
        every_s: float,
        with_replay: bool,
        metadata: Mapping[str, Any],
    ) -> None:
        self.state = state
        self.path = Path(folder) / LAST
        self.metadata = metadata
        self.every_s = every_s
        self.with_replay = with_replay
        self.saved_s = time.monotonic()
        # Longer than every_s where writing takes long.
        self.pause_s = every_s

    def due(self) -> bool:
        """Whether the next checkpoint is due."""
        return time.monotonic() - self.saved_s > self.pause_s

    def save(self) -> None:
        """Write the checkpoint and the current weights."""
        begun = time.monotonic()
        save_checkpoint(self.path, self.state.state_dict(self.with_replay))
        # Weights alone, as an agent's file: it can be driven while the training goes on.
        self.save_weights("last", {})
        self.saved_s = time.monotonic()
        # a slow disk must not slow down the training
        self.pause_s = max(self.every_s, PATIENCE * (self.saved_s - begun))

    def save_weights(self, name: str, figures: Mapping[str, Any]) -> None:
        """Write the online network as ``NAME.safetensors``, with ``figures`` in its metadata."""
        state = self.state
        progress = {
            "decisions": state.decisions,
            "updates": state.agent.updates,
            "wall_s": state.wall_s,
        }
        training = {
            **self.metadata.get("training", {}),
            **progress,
            **figures,
        }
        save_agent(
            self.path.with_name(f"{name}.safetensors"),
            state.agent,
            {**self.metadata, "training": training},
        )


def save_checkpoint(path: str | Path, state: Any) -> None:
    """Write ``state`` (tensors and plain data) atomically, with a checksum of the whole file."""
    # a kill while writing leaves the checkpoint before it
    with atomic_path(path) as part:
        torch.save({"kind": KIND, "version": VERSION, "state": state}, part)
        # The checksum goes into the comment of the archive, which torch does not read.
        seal_archive(part)


def load_checkpoint(
    path: str | Path,
    device: torch.device | str = "cpu",
    key: str = "resume",
) -> Any:
    """Read a file of :func:`save_checkpoint`; never executes code.

    ``key`` is the configuration key of ``path``, for error messages.

    Raises:
        UserError: the file is absent, damaged in any byte, holds weights that are not finite, or is
            no training checkpoint of this version.
    """
    path, option = Path(path), f"{key}={path}"
    if not path.is_file():
        raise UserError(f"{option}: no such file; give a run's folder or its {LAST}.")
    with path.open("rb") as file:
        # Another file, however large, is not searched for a checksum; an empty one has no map.
        archive = file.read(2) == b"PK"
        sealed = archive and has_checksum(
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ),
            option,
        )
    try:
        # weights_only: no pickled object is made, no code runs
        content = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # arbitrary bytes can make the unpickler fail in any way
        raise UserError(
            f"{option}: not a readable checkpoint (truncated, or not written by ganlane); give "
            "another one."
        ) from error
    # First the kind: a file of another program has no checksum of ours either.
    if (
        not isinstance(content, dict)
        or content.get("kind") != KIND
        or content.get("version") != VERSION
    ):
        raise UserError(f"{option}: not a {KIND} of version {VERSION}; give a run's {LAST}.")
    if not sealed:
        refuse_without_checksum(option)
    state = content.get("state")  # :meth:`TrainingState.restore` checks the parts
    agent = state.get("agent") if isinstance(state, dict) else None
    parts = {**state, **agent} if isinstance(state, dict) and isinstance(agent, dict) else {}
    for name in FINITE:
        if not _finite(parts.get(name)):
            raise UserError(
                f"{option}: numbers of its {name} are not finite; give a checkpoint of another run."
            )
    return state


def _finite(state: Any) -> bool:
    """Whether all numbers in the tensors of nested plain data are finite."""
    if isinstance(state, Tensor):
        return bool(state.isfinite().all())
    if isinstance(state, dict):
        return all(map(_finite, state.values()))
    return not isinstance(state, list | tuple) or all(map(_finite, state))


def flat(nested: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Nested plain data by dotted name; tuples become lists, as when read from a file."""
    names: dict[str, Any] = {}
    for name, value in nested.items():
        if isinstance(value, Mapping) and value:
            names |= flat(value, f"{above}{name}.")
        else:
            names[f"{above}{name}"] = list(value) if isinstance(value, tuple) else value
    return names


# --- parts of a checkpoint that are those of this run


def check_parts(
    state: Mapping[str, Any],
    agent: Rainbow,
    environments: Mapping[str, Any],
    stats: EpisodeStats,
) -> None:
    """Compare ``state`` (:meth:`TrainingState.state_dict`) with that of a new run before its use.

    A damaged part would do harm later: Adam writes beyond moments that are too short, and a replay
    buffer that samples rows it does not hold returns arbitrary memory.

    ``agent`` has Adam's moments from the checkpoint already; ``environments`` (their state) and
    ``stats`` are those of the new run.

    Raises:
        ValueError: a part has another structure, shape or type, or impossible numbers.
        TypeError, KeyError, AttributeError: a part has another type altogether.
    """
    network = agent.network.config
    counters = state["counters"]
    replay = state["agent"]["replay"]
    # each moment has the shape of its parameter
    moments = agent.optimizer.state_dict()["state"]
    adam = {
        row: {
            "step": torch.zeros(()),
            "exp_avg": value,
            "exp_avg_sq": value,
        }
        for row, value in enumerate(agent.network.parameters())
    }
    check_like(moments, adam if moments else {}, "optimizer")
    check_like(state["agent"]["updates"], 0, "updates")
    best = None if counters["best"] is None else 0.0
    # The numbers stand for their types; see check_like().
    check_like(
        counters,
        {
            "decisions": 0,
            "pending_decisions": 0,
            "wall_s": 0.0,
            "best": best,
        },
        "counters",
    )
    if replay is not None:
        _check_replay(replay, agent)
    if state["window"] is None:  # the resumed run will not be exact
        return
    # the environments, and whether their masks are in the buffer too
    check_like(state["env_state"], environments, "env_state")
    # masks are there in both or in neither
    mask = environments["items"].get(keys.ACTION_MASK)
    if replay["rows"] and (MASK in replay["rows"]) != (mask is not None):
        raise ValueError("replay: its masks are those of another run")
    # each step of the window is like a row of the buffer
    rows = transitions(len(stats.discount), network)
    steps = state["window"]["steps"]
    observation = rows["observation"]
    end = rows["next.terminated"]
    step = Step(
        observation,
        rows["action"],
        rows["next.reward"],
        observation,
        end,
        end,
        mask,
    )._asdict()
    check_like(
        steps,
        [step] * min(len(steps), agent.config.n_step - 1),
        "window",
    )
    for step in steps:
        _check_actions(step["action"], network)
    # sums may be absent (nothing happened yet), never of another shape
    saved = state["stats"]
    one = torch.zeros((), dtype=torch.float64)
    sums = {
        name: one.expand(len(stats.actions)) if name == "actions" else one for name in saved["sums"]
    }
    updates = dict.fromkeys(saved["updates"], torch.zeros(()))
    check_like(
        saved,
        {**stats.state_dict(), "sums": sums, "updates": updates},
        "stats",
    )
    if updates and saved["update_count"] == 0:
        raise ValueError("stats: sums over no update")


def _check_replay(replay: Mapping[str, Any], agent: Rainbow) -> None:
    rows = replay["rows"]
    cursor = replay["cursor"]
    config = agent.config
    # the buffer holds rows 0 to count - 1
    count = len(rows["action"]) if rows else 0
    check_like(replay, {"cursor": 0, "writes": 0}, "replay")
    if rows:
        like = transitions(count, agent.network.config)
        check_like(
            rows,
            {name: like[name] for name in like if name != MASK or MASK in rows},
            "replay",
        )
        _check_actions(rows["action"], agent.network.config)
        steps = rows["steps_to_next_obs"]
        if ((steps < 1) | (steps > config.n_step)).any():
            raise ValueError("replay: transitions of more steps than the run's")
    # until it is full the next row is the first free one, then any
    if not (cursor == count < config.capacity or cursor < count == config.capacity):
        raise ValueError(f"replay: {count} rows of {config.capacity}, the next one is {cursor}")
    if config.prioritised:
        # of whole rows, in which the items that exist have a priority
        in_use = torch.arange(-(-count // ROW) * ROW, device=agent.device).view(-1, ROW) < count
        sampler = {
            "priorities": in_use.float(),
            "largest": torch.zeros(()),
            "beta": 0.0,
        }
        check_like(replay["sampler"], sampler, "replay.sampler")
        if not torch.equal(replay["sampler"]["priorities"] > 0, in_use):
            raise ValueError("replay: priorities of rows that do not exist")


def _check_actions(taken: Tensor, network: NetworkConfig) -> None:
    if ((taken < 0) | (taken >= network.actions)).any():
        raise ValueError("actions out of range")


def transitions(rows: int, network: NetworkConfig) -> dict[str, Tensor]:
    """Shapes and types of the rows of the replay buffer as meta tensors, by dotted key."""
    # meta tensors have shape and type, and take no memory
    number = torch.empty(rows, 1, device="meta")
    observation = number.expand(rows, network.observation_size)
    after = {
        "next.observation": observation,
        "next.reward": number,
        "next.terminated": number.bool(),
    }
    after[MASK] = number.expand(rows, network.actions).bool()
    return {
        "observation": observation,
        "action": number[:, 0].long(),
        "steps_to_next_obs": number,
        **after,
    }


def check_like(
    value: Any,
    like: Any,
    name: str,
) -> None:
    """Raise :class:`ValueError` unless ``value`` has the lengths, shapes and types of ``like``.

    It may have more keys. Numbers outside tensors must be finite, counts at least 0.
    """
    if isinstance(like, Tensor):
        fits = isinstance(value, Tensor) and (
            value.shape,
            value.dtype,
        ) == (like.shape, like.dtype)
    elif isinstance(like, dict):
        fits = isinstance(value, dict) and value.keys() >= like.keys()
    elif isinstance(like, list):
        fits = isinstance(value, list) and len(value) == len(like)
    elif isinstance(like, int):
        fits = type(value) is int and 0 <= value < MOST
    elif isinstance(like, float):
        fits = type(value) in (int, float) and isfinite(value)
    else:
        fits = value is like
    if not fits:
        raise ValueError(f"{name} cannot be of this run")
    if isinstance(like, dict | list):
        for key in like if isinstance(like, dict) else range(len(like)):
            check_like(value[key], like[key], f"{name}.{key}")
