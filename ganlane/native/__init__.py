"""Rule-driven traffic as a native kernel: the fast twin of the tensor code, for CPUs, in float32.

``kernel.cpp`` drives one decision (ego command, IDM, MOBIL, steering, bicycle, collisions, events, recycling) for as
many environments at once as a vector holds, ``observation.cpp`` writes the lane view, ``mask.cpp`` the action mask.
:mod:`~ganlane.native.library` builds and loads them; :mod:`~ganlane.native.decision`,
:mod:`~ganlane.native.observation` and :mod:`~ganlane.native.mask` call them on tensors. The tensor code stays the
reference: tests hold the two together.
"""

from ganlane.native.decision import EgoState, Kernel, Outcome
from ganlane.native.library import why_not
from ganlane.native.mask import SafeActions
from ganlane.native.observation import LaneView

__all__ = ["EgoState", "Kernel", "LaneView", "Outcome", "SafeActions", "why_not"]
