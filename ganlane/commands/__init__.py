"""What the commands do: ``ganlane.commands.NAME.NAME(config, folder)``, called by the entry point
``ganlane.NAME``.

These modules import torch and everything else they need. The entry points import them only when the
command line has been checked, so that a typing mistake is reported in a third of a second.
"""
