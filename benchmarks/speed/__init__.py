"""How fast the simulator and a training are, in turns with their peers (docs/speed.md).

``systems`` makes what is measured ready to run, ``measure`` times it, ``__main__`` is the command.
"""

import os

# Before torch is imported: a thread of OpenMP that spins while it waits takes time from the others.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
