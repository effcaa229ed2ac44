"""``ganlane reproduce``: every driver on every traffic; the paper's tables and figures from it.

    ganlane reproduce
    ganlane reproduce episodes=50 'traffics=[idm_mobil,gan]'
    ganlane reproduce 'agents=[random_legal,mobil,agent_idm@all]'
    ganlane reproduce 'runs=[outputs/train/SEED_0,outputs/train/SEED_1]'
    ganlane reproduce source=scratch

All drivers drive the same episodes. Writes results.json, report.html, crashes.json (for ``ganlane
render crashes=FILE``), figures (PNG, SVG) and a CSV behind each into its run folder. What was
driven stays in ``cells``: a command that was stopped goes on where it was, and one with other
drivers drives those alone.

Modules:

- :mod:`~ganlane.reproduce.cells`: drives, cell by cell (:mod:`ganlane.compare`).
- :mod:`~ganlane.reproduce.episodes`: records an episode for a picture.
- :mod:`~ganlane.reproduce.report`: numbers, tables and the page.
- :mod:`~ganlane.reproduce.figures`: the paper's figures and the picture of the matrix.
- :mod:`~ganlane.reproduce.crashes`: lists crashes, and drives them again.
"""
