"""From words to a run: Hydra composes plain data, a record checks them, the command is called.

``compose.py`` makes plain data of a command line, a Python call or a saved run; ``run.py`` has the
run folder, sweeps, errors and exit statuses; ``help.py`` the text of ``--help``.
"""
