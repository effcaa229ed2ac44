"""What the commands do, as typed calls for a notebook or a script; nothing of Hydra is needed.

::

    import ganlane

    env = ganlane.make_env(traffic="gan", num_envs=256, lanes=4)
    agent = ganlane.load_agent("agent_idm")
    table = ganlane.evaluate(agents=[agent, "mobil", "random_legal"], traffics=["idm_mobil", "gan"], episodes=100)

:mod:`~ganlane.api.options` turns names, mappings and keyword arguments into the config dataclasses of the command
line, with the same checks and the same sentences. :mod:`~ganlane.api.parts` makes environments and drivers,
:mod:`~ganlane.api.comparing` evaluates; :mod:`~ganlane.api.training`, :mod:`~ganlane.api.filming`,
:mod:`~ganlane.api.measuring` and :mod:`~ganlane.api.recordings` hold the calls that write into a run folder
(:mod:`~ganlane.api.folders`). A mistake ends in :class:`ganlane.errors.UserError`, one sentence.
"""

from ganlane.api.comparing import evaluate
from ganlane.api.filming import render
from ganlane.api.folders import Run
from ganlane.api.measuring import bench, realism
from ganlane.api.parts import load_agent, make_env
from ganlane.api.recordings import GeneratorRun, prepare, train_generator
from ganlane.api.training import TrainingRun, train
from ganlane.build import Driver

__all__ = [
    "Driver",
    "GeneratorRun",
    "Run",
    "TrainingRun",
    "bench",
    "evaluate",
    "load_agent",
    "make_env",
    "prepare",
    "realism",
    "render",
    "train",
    "train_generator",
]
