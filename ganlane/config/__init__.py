"""Configuration of the commands: one dataclass per option; ``conf/GROUP/NAME.yaml`` holds what differs from it.

The numbers themselves are declared in :mod:`ganlane.parameters`. The options of ``agent``, ``observation``, ``mask``,
``reward``, ``data`` and ``generator`` are those records as they are. ``env`` with ``scenarios`` and ``traffic`` hold
the options of these groups, ``train`` also those of ``init``, ``collector`` and ``logger``. ``train``, ``evaluate``,
``render``, ``recordings`` and ``bench`` hold the commands' roots, and ``run`` what these share. ``experiment`` needs
no schema: its options only set the keys of the others. A notebook uses the dataclasses without Hydra.

``app`` runs a command: ``command_line`` reads the arguments and composes and checks the configuration with
``schemas``, ``resume`` adds the command line of the run to go on with, all before ``folders`` makes anything.
``messages`` turns errors into sentences, ``help`` explains, ``completion`` completes in a shell, and ``targets``
imports a user's own parts by name.
"""
