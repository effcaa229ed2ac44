"""Every number that a user can set: one frozen dataclass per part, with default, range, unit and source.

Each is declared here and nowhere else. The simulator, the traffic and the agent take these records, and they are the
command line's schemas as they stand (:mod:`ganlane.config`). Annotations hold the ranges, which are checked when a
record is made (:mod:`~ganlane.parameters.checks`). Errors name the field; the command line puts the key before it.

Nothing here imports torch, nor a package that does (``ganlane.sim`` and the others import it in their
``__init__``): so a mistyped key is reported before torch, which takes seconds to load. The packages that work with a
record import it from here, and still offer it by its name (``ganlane.sim.IdmParameters``).
"""
