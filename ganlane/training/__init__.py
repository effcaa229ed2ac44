"""Training: phases, each of which is one run of the loop, watched, stopped and resumed.

:mod:`~ganlane.training.loop` is the algorithm; read it first. :mod:`~ganlane.training.phases` makes
of a config what it works on, :mod:`~ganlane.training.collectors` steps the environments,
:mod:`~ganlane.training.stats` sums up what happens, :mod:`~ganlane.training.logs` writes and shows
it, and :mod:`~ganlane.training.checkpoint` saves and resumes it.
"""
