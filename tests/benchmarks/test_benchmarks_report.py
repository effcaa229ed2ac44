"""Tables in a document: between the markers, whole, and without a machine's name."""

from __future__ import annotations

import platform
from pathlib import Path

import pytest

from ganlane.benchmarks import report_sections, update_document
from ganlane.benchmarks.report import machine_sentence, markers, require_markers
from ganlane.benchmarks.tables import Table
from ganlane.errors import UserError

BEGIN, END = markers("sim")


class Tiny:
    """A suite with one table."""

    name, memory, notes = "sim", False, []

    def tables(self, rows, findings):
        return [Table("Speed", ["who", "n"], [[row["who"], str(row["n"])] for row in rows])]


NUMBERS = {"rows": [{"who": "mine", "n": 3}], "notes": ["Not measured: compiled."]}


def test_only_what_stands_between_the_markers_changes(tmp_path):
    document = tmp_path / "performance.md"
    document.write_text(f"# Title\n{BEGIN}\nold\n{END}\ntail é\n", encoding="utf-8")
    for content in ("new", "newer"):
        update_document(document, "sim", content)
        assert document.read_text(encoding="utf-8") == f"# Title\n{BEGIN}\n{content}\n{END}\ntail é\n"


@pytest.mark.parametrize("text", ["nothing", BEGIN, f"{END}\n{BEGIN}", f"{BEGIN}{BEGIN}{END}"])
def test_a_document_without_both_markers_is_refused_and_kept(tmp_path, text):
    document = tmp_path / "performance.md"
    document.write_text(text)
    with pytest.raises(UserError, match="once each"):
        update_document(document, "sim", "new")
    assert document.read_text() == text


def test_a_missing_document_is_refused(tmp_path):
    with pytest.raises(UserError, match="no such file"):
        require_markers(tmp_path / "gone.md", "sim")


def test_sections_tell_command_machine_tables_and_what_is_missing():
    shown = report_sections(Tiny(), NUMBERS, "python -m ganlane.bench suite=sim", [1, 2], "2026-01-31")
    for part in ("    python -m ganlane.bench suite=sim", "2026-01-31", "| mine | 3 |", "- Not measured: compiled."):
        assert part in shown


def test_the_machine_has_no_name_and_no_path():
    shown = machine_sentence([1, 2])
    assert "threads: 1, 2" in shown
    assert "torch" in shown
    assert platform.node() not in shown.split()
    assert str(Path.cwd()) not in shown


def test_the_document_of_the_project_can_be_written():
    require_markers(Path(__file__).parents[2] / "docs" / "performance.md", "sim")
