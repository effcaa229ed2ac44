"""One line of the report: what was looked at, what was found, and the command that mends it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

#: What to do where a part cannot even be looked at.
BROKEN = "mend what is MISSING above, then run ganlane doctor again"


class State(Enum):
    """``MISSING`` is needed and makes the exit status 1; ``ABSENT`` is for further purposes only."""

    OK = "ok"
    ABSENT = "absent"
    MISSING = "MISSING"


@dataclass(frozen=True)
class Finding:
    """``subject`` was looked at, and ``found`` is what there is; ``mend`` is what to type where something lacks."""

    subject: str
    state: State
    found: str
    mend: str = ""

    def lines(self) -> list[str]:
        """As the report shows it."""
        first = f"  {self.state.value:<8}{self.subject:<22}{self.found}"
        return [first, f"          mend: {self.mend}"] if self.mend else [first]


def guarded(subject: str, look: Callable[[], Finding], mend: str) -> Finding:
    """What ``look`` finds; whatever it raises is a finding too, since a broken installation can fail in any way."""
    try:
        return look()
    except Exception as error:
        told = " ".join(str(error).split()) or type(error).__name__
        return Finding(subject, State.MISSING, told, mend)


def report(sections: Mapping[str, Sequence[Finding]]) -> str:
    """All findings, section by section, and in the last line what follows from them."""
    blocks = [
        "\n".join([title, *(line for finding in findings for line in finding.lines())])
        for title, findings in sections.items()
    ]
    return "\n\n".join([*blocks, verdict(sections)])


def missing(sections: Mapping[str, Sequence[Finding]]) -> list[str]:
    """What is needed and not there."""
    return [found.subject for findings in sections.values() for found in findings if found.state is State.MISSING]


def verdict(sections: Mapping[str, Sequence[Finding]]) -> str:
    """One sentence."""
    lacking = missing(sections)
    if lacking:
        return f"Missing: {', '.join(lacking)}; run what stands beside 'mend'."
    return "All that is needed is there; what is absent serves further purposes only."
