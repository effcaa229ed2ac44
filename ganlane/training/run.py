"""Everything the rest of a run follows from: agent, window, source of steps, counters. Can be saved and restored."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl.envs import EnvBase

from ganlane.agents import Rainbow
from ganlane.errors import UserError
from ganlane.training.checkpoints import load_checkpoint
from ganlane.training.collectors import Source, source_of
from ganlane.training.meter import Meter

#: Key of an identity for the defaults of its options.
DEFAULTS = "defaults"
#: Of an identity, how the run is computed: may change when it goes on, which is bit-exact only where it does not.
COMPUTED_BY = ("env.compile",)
#: What the checkpoint of a run holds.
PARTS = {"agent", "window", "carrier", "meter", "counters", "identity"}


class Run:
    """State of a run of ``agent`` in ``env``, batch [N].

    ``source`` gives the steps of the environments; ``owed`` counts the decisions not yet paid for by an update;
    ``best`` is the best evaluation so far. ``identity`` is plain data that a resumed run must share: environment,
    traffic, reward, seed; under :data:`DEFAULTS`, which is not saved, the defaults of its options by dotted name.
    """

    def __init__(self, env: EnvBase | Source, agent: Rainbow, identity: Mapping[str, Any] | None = None) -> None:
        self.source, self.agent, self.identity = source_of(env), agent, dict(identity or {})
        #: Of options that the identity of an older run does not name.
        self.defaults = self.identity.pop(DEFAULTS, {})
        self.environments = self.source.environments
        self.window = agent.window()
        self.meter = Meter(self.environments, agent.network.config.actions, agent.config.gamma, agent.device)
        self.decisions, self.owed = 0, 0
        self.best: float | None = None
        #: Decisions at the last evaluation.
        self.assessed = 0
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
        starts the next ones, and is not bit-exact. So it is with a source that cannot be resumed exactly.
        """
        exact = with_replay and self.source.exact
        counters = {"decisions": self.decisions, "owed": self.owed, "wall_s": self.wall_s, "best": self.best}
        return {
            "agent": self.agent.state_dict(with_replay),
            "window": self.window.state_dict() if exact else None,
            "carrier": self.source.state_dict(exact),
            "meter": self.meter.state_dict() if exact else None,
            "counters": counters,
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
        if not isinstance(state, dict) or not state.keys() >= PARTS:
            raise UserError(f"resume={path}: parts of the run are missing in it; give another checkpoint.")
        refuse_another_run(
            path, {**self.defaults, **flat(state["identity"])}, {**self.defaults, **flat(self.identity)}
        )
        exact = state["window"] is not None
        try:
            self.source.load_state_dict(state["carrier"], exact)
        except ValueError as error:
            raise UserError(
                f"resume={path}: saved with environments of shape {error}, this run has [{self.environments}]; use "
                "the same number."
            ) from error
        self.agent.load_state_dict(state["agent"])
        if exact:
            self.window.load_state_dict(state["window"])
            self.meter.load_state_dict(state["meter"])
        counters = state["counters"]
        self.decisions, self.owed, self.best = (counters[name] for name in ("decisions", "owed", "best"))
        self._before_s = counters["wall_s"]
        if state["agent"]["replay"] is None:
            return "the replay buffer: it is filled again before the next update"
        return None if exact else "the episodes that were under way: the workers begin the next ones"


def refuse_another_run(path: str | Path, saved: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    """Raise :class:`UserError` where the run that was saved is not the one that is asked for."""
    theirs, ours = flat(saved), flat(asked)
    for name in (*ours, *theirs):
        if name not in COMPUTED_BY and theirs.get(name) != ours.get(name):
            raise UserError(
                f"resume={path}: {name}={ours.get(name)}, but the run was started with {theirs.get(name)}; "
                "go on with that, or start a new run."
            )


def flat(nested: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Nested plain data as dotted names; tuples as lists, which is how they come back from a file."""
    names: dict[str, Any] = {}
    for name, value in nested.items():
        if isinstance(value, Mapping) and value:
            names |= flat(value, f"{above}{name}.")
        else:
            names[f"{above}{name}"] = list(value) if isinstance(value, tuple) else value
    return names
