"""The parts of ``benchmarks/traffic_ablations.py``.

:mod:`~benchmarks.ablations.variants` says what is changed (two of the changes are networks of their own, in
:mod:`~benchmarks.ablations.networks`), :mod:`~benchmarks.ablations.driving` drives a variant and counts, and
:mod:`~benchmarks.ablations.tables` shows the numbers.
"""
