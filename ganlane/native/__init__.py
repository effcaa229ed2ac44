"""Rule-driven traffic as a native kernel: the fast twin of the tensor code, for CPUs, in float32.

``kernel.cpp`` drives one decision (ego command, IDM, MOBIL, steering, bicycle, collisions, events, recycling) for as
many environments at once as a vector holds, ``observation.cpp`` writes the lane view, ``mask.cpp`` the action mask,
``spawn.cpp`` the first scenes, and ``step.cpp`` makes a whole step of them, with the reward.

:mod:`~ganlane.native.library` builds and loads them. :mod:`~ganlane.native.decision`, :mod:`~ganlane.native.scenes`,
:mod:`~ganlane.native.observation` and :mod:`~ganlane.native.mask` call them on tensors, for the TorchRL environment;
:mod:`~ganlane.native.batch` calls the whole step on NumPy arrays, for gymnasium, and needs no torch. The tensor code
stays the reference: tests hold all of them together.
"""
