"""``ganlane benchmark``: agents on a frozen suite of traffics, with one score.

All drivers drive the same episodes. What was driven stays in ``cells``: a command that was stopped
goes on where it was, and one with other drivers drives those alone.

Modules:

- :mod:`~ganlane.suite.driving`: drivers on traffics (also ``ganlane evaluate``), for a suite cell
  by cell, each stored in a file; an episode for a film.
- :mod:`~ganlane.suite.scores`: numbers with the training as the unit.
- :mod:`~ganlane.suite.report`: the table, and the page with films.
- :mod:`~ganlane.suite.run`: all of it, from drivers to results.
"""
