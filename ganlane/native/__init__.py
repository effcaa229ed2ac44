"""Rule-driven traffic as a native kernel: the fast twin of the tensor code, for CPUs, in float32.

``kernel.cpp`` drives one decision (ego command, IDM, MOBIL, steering, bicycle, collisions, events,
recycling) for as many environments at once as a vector holds, ``observation.cpp`` writes the lane
view, ``mask.cpp`` the action mask, ``spawn.cpp`` the first scenes, and ``step.cpp`` makes a whole
step of them, with the reward.

:mod:`~ganlane.native.library` builds, loads and calls them: :mod:`~ganlane.native.tensors` on
tensors, for the TorchRL environment, and :mod:`~ganlane.native.batch` on NumPy arrays, a whole step
at once, for gymnasium and without torch. The tensor code stays the reference: tests hold all of
them together.
"""
