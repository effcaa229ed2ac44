"""All findings, in the order of the report."""

from __future__ import annotations

from ganlane.diagnosis.contents import contents
from ganlane.diagnosis.finding import Finding
from ganlane.diagnosis.machine import machine
from ganlane.diagnosis.software import extras, software


def examine() -> dict[str, list[Finding]]:
    """Title of a section to what was found; loads every shipped checkpoint, so it takes seconds."""
    return {
        "software": software(),
        "machine": machine(),
        "files": contents(),
        "extras (not needed)": extras(),
    }
