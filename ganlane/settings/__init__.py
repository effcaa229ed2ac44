"""Every number that a user can set: one frozen record per part, with default, range, unit, source.

Each is declared here and nowhere else; the simulator, the traffic and the agent take these records.
``record.py`` is the engine: a record's constructor takes plain data and is the only check, whether
the data come from Python, the command line, YAML or a saved run. Nothing here imports torch, nor a
package that does: so a mistyped key is reported before torch, which takes seconds to load.
"""
