"""The native kernel: the fast twin of the tensor code, for CPUs, in float32.

``kernel.cpp`` drives one decision (ego command, traffic, collisions, events, recycling) for as many
environments at once as a vector holds. The others are rule-driven (``rows.hpp``: IDM, MOBIL,
steering, bicycle), with mistakes (``faults.hpp``) or no two alike (``random_drivers.hpp``), or
generated (``generated.hpp``) by the network in ``network.hpp``. ``observation.cpp`` writes the lane
view, ``mask.cpp`` the action mask, ``spawn.cpp`` the first scenes, and ``step.cpp`` makes a whole
step of them, with the reward.

:mod:`~ganlane.native.drivers` says which traffics the kernel drives, and with which numbers.
:mod:`~ganlane.native.library` builds, loads and calls it: :mod:`~ganlane.native.tensors` on
tensors, for the TorchRL environment, and :mod:`~ganlane.native.batch` on NumPy arrays, a whole step
at once, for gymnasium and without torch. The tensor code stays the reference: tests hold all of
them together.
"""
