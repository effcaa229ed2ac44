"""Configuration of the commands: one dataclass per option; ``conf/GROUP/NAME.yaml`` holds what
differs from it.

The numbers themselves are declared in :mod:`ganlane.parameters`. The options of ``agent``,
``observation``, ``mask``, ``reward``, ``data`` and ``generator`` are those records as they are.
``env`` and ``traffic`` hold the options of these groups, ``train`` also those of ``init``,
``collector`` and ``logger``. ``commands``, ``render``, ``recordings`` and ``train`` hold the
commands' roots. ``experiment`` needs no schema: its options only set the keys of the others. A
notebook uses the dataclasses without Hydra.

``app`` runs a command: ``command_line`` reads the arguments, composes and checks the configuration
with ``schemas``, and turns errors into sentences; ``runs`` adds the command line of the run to go
on with and makes the run's folder. ``help`` explains, and completes in a shell.
"""
