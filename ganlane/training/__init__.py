"""Training: one loop, and what it needs to be watched, stopped and resumed.

:mod:`~ganlane.training.loop` is the algorithm; read it first. :mod:`~ganlane.training.run` is what it works on,
:mod:`~ganlane.training.meter` sums up what happens, :mod:`~ganlane.training.log` and
:mod:`~ganlane.training.progress` write and show it, :mod:`~ganlane.training.saver` and
:mod:`~ganlane.training.checkpoints` save it, :mod:`~ganlane.training.stop` turns Ctrl-C into a clean end.
"""

from ganlane.training.checkpoints import find_checkpoint
from ganlane.training.config import TrainingConfig, TrainingResult
from ganlane.training.further import make_logs
from ganlane.training.loop import train

__all__ = ["TrainingConfig", "TrainingResult", "find_checkpoint", "make_logs", "train"]
