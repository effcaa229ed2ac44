"""Measuring speed and memory so that two figures can be compared on a machine that also does other things.

A suite (:class:`~ganlane.benchmarks.case.Suite`) names what there is to measure as groups of cases; a case has
labels and starts something that takes so many decisions. :mod:`~ganlane.benchmarks.timing` runs the cases of a group
in turn, A B C A B C, and takes wall and CPU time of each turn; :mod:`~ganlane.benchmarks.memory` runs a case in a
fresh process for its peak memory. :mod:`~ganlane.benchmarks.rows` makes rows of medians and ratios of that, and the
suite its findings; :mod:`~ganlane.benchmarks.report` prints them and writes them into a document.

:mod:`~ganlane.benchmarks.sim` is the suite of the simulator: its own systems are in
:mod:`~ganlane.benchmarks.systems`, the simulators of others in :mod:`~ganlane.benchmarks.peers`, what follows from
its rows in ``sim_findings`` and ``sim_tables``. :mod:`~ganlane.benchmarks.traffic` is that of the traffic models, and
:mod:`~ganlane.benchmarks.train` that of the training loop: ``train_loop`` runs it, ``train_shares`` puts timers round
its calls, ``train_losses`` and ``train_peer`` are what it is held against. A further suite is one more module with
such a class, and one more entry in ``ganlane.bench.SUITES``.
"""

from ganlane.benchmarks.case import Case, Group, Labels, Suite
from ganlane.benchmarks.measure import measure
from ganlane.benchmarks.report import print_report, report_sections, update_document
from ganlane.benchmarks.sim import SimOptions, SimSuite
from ganlane.benchmarks.timing import Budget

__all__ = [
    "Budget",
    "Case",
    "Group",
    "Labels",
    "SimOptions",
    "SimSuite",
    "Suite",
    "measure",
    "print_report",
    "report_sections",
    "update_document",
]
