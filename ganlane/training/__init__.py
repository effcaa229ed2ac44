"""Training: phases, each of which is one run of the loop, watched, stopped and resumed.

:mod:`~ganlane.training.loop` is the algorithm; read it first. :mod:`~ganlane.training.phases` makes
of a config what it works on, :mod:`~ganlane.training.collectors` and
:mod:`~ganlane.training.workers` step the environments, :mod:`~ganlane.training.stats` sums up what
happens, :mod:`~ganlane.training.logs` writes and shows it, and :mod:`~ganlane.training.checkpoint`
saves and resumes it.
"""

from ganlane.training.checkpoint import TrainingState
from ganlane.training.loop import TrainingConfig, TrainingResult, train
from ganlane.training.phases import AGENT_FILE, Phase, make_agent, phases_of, run_phase

__all__ = [
    "AGENT_FILE",
    "Phase",
    "TrainingConfig",
    "TrainingResult",
    "TrainingState",
    "make_agent",
    "phases_of",
    "run_phase",
    "train",
]
