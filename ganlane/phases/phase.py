"""The phases of a run, and where each goes on when the run is resumed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ganlane.config.traffic import TrafficConfig
from ganlane.config.train import TrainConfig
from ganlane.training import find_checkpoint

#: The trained agent, in the folder of its phase; its presence says that the phase is over.
AGENT_FILE = "agent.safetensors"


@dataclass(frozen=True)
class Phase:
    """A stretch of training on one traffic: where its files go, what it starts from (None: random weights)."""

    name: str
    folder: Path
    traffic: TrafficConfig
    total_decisions: int
    init: str | None


def phases_of(config: TrainConfig, folder: Path) -> list[Phase]:
    """The phases that ``config`` asks for, in order."""
    main = Phase("train", folder, config.traffic, config.total_decisions, config.init.path)
    before = config.pretrain
    if before.total_decisions == 0 or before.traffic is None:
        return [main]
    first = Phase("pretrain", folder / "pretrain", before.traffic, before.total_decisions, config.init.path)
    return [first, Phase("train", folder, config.traffic, config.total_decisions, str(first.folder / AGENT_FILE))]


def checkpoint_of(phase: Phase, resume: str | None) -> Path | None:
    """Where ``phase`` goes on in a resumed run: its own checkpoint, if it had got so far as to write one."""
    if resume is None:
        return None
    own = phase.folder / "checkpoints" / "last.pt"
    return find_checkpoint(own, phase.folder) if own.is_file() else None
