"""Configuration of the commands: one dataclass per option; the YAML at the same place under conf/ holds the values.

The options of ``agent``, ``reward`` and ``mask`` are records of :mod:`ganlane.parameters` as they stand. ``env``,
``traffic``, ``init``, ``observation``, ``collector``, ``logger``, ``data`` and ``generator`` hold the options of the
groups of these names, with such records in them or as their bases; ``train``, ``evaluate``, ``render``, ``prepare``,
``train_generator``, ``realism`` and ``bench`` the root of each command; ``experiment`` needs no schema, since its
options only set the keys of the others. Environments that start in a scene set by hand stand in ``scenarios``,
``scene`` and ``scene_file``, traffics with faults and recorded traffic in ``traffic_faults`` and
``traffic_replay``. The dataclasses are plain, and a notebook uses them without Hydra. Making one checks its ranges
(:mod:`ganlane.parameters.checks`).

``app`` is the frame around every command: ``overrides`` reads the command line, ``resume`` adds that of the run to go
on with, ``compose`` composes and checks (with ``store``), all before ``folders`` makes anything; ``messages`` says in
a sentence what is wrong, ``disk`` what the file system refuses, ``streams`` lets go of an output that nobody reads,
``help`` explains, ``completion`` completes in a shell, ``targets`` imports a user's own parts by name, ``nodes``
turns dataclasses into OmegaConf's nodes and back, and ``plain`` hands values on to the packages below.
"""
