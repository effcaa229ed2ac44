"""The frame of the benchmark scripts: when a document is refused, what stands in it, and the exit status."""

import pytest
import torch

from ganlane.benchmarks.script import ReportSection, add_report, parser_of, run_script
from ganlane.errors import UserError

BEGIN, END = "<!-- begin -->", "<!-- end -->"


def test_the_help_is_the_story_as_it_stands_and_names_the_markers(capsys):
    parser = parser_of("What is measured.\n\n    python benchmarks/this.py --report FILE\n")
    add_report(parser, BEGIN, END)
    with pytest.raises(SystemExit, match="0"):
        parser.parse_args(["--help"])
    told = capsys.readouterr().out
    assert "\n    python benchmarks/this.py --report FILE\n" in told
    assert BEGIN in told
    assert END in told


def test_only_what_stands_between_the_markers_is_written_anew(tmp_path):
    document = tmp_path / "page.md"
    document.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    ReportSection(document, BEGIN, END).write("new")
    assert document.read_text() == f"before\n{BEGIN}\nnew\n{END}\nafter\n"


def test_a_document_without_the_markers_is_refused_at_once(tmp_path):
    document = tmp_path / "page.md"
    document.write_text("nothing here\n")
    with pytest.raises(UserError, match="once each"):
        ReportSection(document, BEGIN, END)
    assert document.read_text() == "nothing here\n"


def test_without_a_document_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ReportSection(None, BEGIN, END).write("new")
    assert list(tmp_path.iterdir()) == []


def test_what_was_measured_is_printed_and_ends_well(capsys):
    parser = parser_of(None)
    parser.add_argument("--seed", type=int)
    told = parser.parse_args(["--seed", "3"])
    assert run_script(lambda told: f"seed {told.seed}, {torch.get_num_threads()} thread", told) == 0
    assert capsys.readouterr().out == "seed 3, 1 thread\n"


def test_a_users_mistake_is_one_sentence_and_status_2(capsys):
    def refuse(told):
        raise UserError("seed=-1: expected 0 or more.")

    assert run_script(refuse, parser_of(None).parse_args([])) == 2
    assert capsys.readouterr() == ("", "error: seed=-1: expected 0 or more.\n")
