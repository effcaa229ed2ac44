"""Rule-driven traffic as a native kernel: the fast twin of the tensor code, for CPUs, in float32.

``kernel.cpp`` drives one decision (ego command, IDM, MOBIL, steering, bicycle, collisions, events, recycling) for as
many environments at once as a vector holds; :mod:`~ganlane.native.library` builds and loads it,
:mod:`~ganlane.native.decision` calls it on tensors. ``observation.cpp`` and :mod:`~ganlane.native.observation` do the
same for the lane view. The tensor code stays the reference: tests hold the two together.
"""

from ganlane.native.decision import EgoState, Kernel, Outcome
from ganlane.native.library import why_not
from ganlane.native.observation import LaneView

__all__ = ["EgoState", "Kernel", "LaneView", "Outcome", "why_not"]
