"""What ``ganlane doctor`` looks at: software, machine and files, each as findings with the command that mends them.

A :class:`Finding` is one line of the report; :func:`examine` gathers them and :func:`report` prints them.
:mod:`~ganlane.diagnosis.software` compares versions with what the package asks for,
:mod:`~ganlane.diagnosis.machine` looks at processor, graphics card and compiler,
:mod:`~ganlane.diagnosis.contents` at what is read and written. Nothing here needs an installation that works: what
cannot be imported is found to be missing, not raised.
"""

from ganlane.diagnosis.finding import Finding, State, missing, report
from ganlane.diagnosis.sections import examine

__all__ = ["Finding", "State", "examine", "missing", "report"]
