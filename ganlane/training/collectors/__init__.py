"""Where the steps come from: this process, worker processes, or machines of a Ray cluster.

A :class:`~ganlane.training.collectors.source.Source` gives the loop one decision of all its environments at a time,
in the order of time, so the loop is the same for all of them. :class:`SingleSource` steps the environments in process
and can be resumed to the same bits. :class:`MultiSource` and :class:`RaySource` are TorchRL's ``MultiSyncCollector``
and ``RayCollector``; what they share is in :mod:`~ganlane.training.collectors.workers`, what runs on the other side
in :mod:`~ganlane.training.collectors.remote`.
"""

from ganlane.training.collectors.multi import MultiSource
from ganlane.training.collectors.ray_cluster import RaySource
from ganlane.training.collectors.remote import MakeEnv
from ganlane.training.collectors.single import SingleSource
from ganlane.training.collectors.source import Source, source_of
from ganlane.training.collectors.workers import Team

__all__ = ["MakeEnv", "MultiSource", "RaySource", "SingleSource", "Source", "Team", "source_of"]
