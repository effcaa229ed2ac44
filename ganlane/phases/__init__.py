"""Training runs from plain configs: one phase or two, each resumable; the second starts from the first's agent.

:func:`phases_of` a config are one or two :class:`Phase`; :func:`run_phase` makes the source of steps
(:func:`make_source`) and the agent (:func:`make_agent`), trains, and leaves the agent in the folder of the phase.
What a phase can start from is in :mod:`ganlane.phases.start`.
Agents are chosen by episodes of a stream of their own (:mod:`ganlane.phases.selection`); what is written beside their
weights is in :mod:`ganlane.phases.description`.
"""

from ganlane.phases.agent import check_finished, check_observation, length_of, make_agent
from ganlane.phases.description import describe, identity
from ganlane.phases.phase import AGENT_FILE, Phase, checkpoint_of, phases_of
from ganlane.phases.run import run_phase
from ganlane.phases.source import make_source, training_env, worker_env
from ganlane.phases.start import Start, read_start

__all__ = [
    "AGENT_FILE",
    "Phase",
    "Start",
    "check_finished",
    "check_observation",
    "checkpoint_of",
    "describe",
    "identity",
    "length_of",
    "make_agent",
    "make_source",
    "phases_of",
    "read_start",
    "run_phase",
    "training_env",
    "worker_env",
]
