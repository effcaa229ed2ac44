"""What the scripts share: a document is refused or written into, and the exit status."""

import pytest
import torch

from benchmarks.script import ReportSection, add_report, make_parser, run_script
from ganlane.errors import UserError

BEGIN, END = "<!-- begin -->", "<!-- end -->"


def test_the_help_is_the_description_unchanged_and_names_the_markers(capsys):
    parser = make_parser("What is measured.\n\n    python -m benchmarks.this --report FILE\n")
    add_report(parser, BEGIN, END)
    with pytest.raises(SystemExit, match="0"):
        parser.parse_args(["--help"])
    shown = capsys.readouterr().out
    assert "\n    python -m benchmarks.this --report FILE\n" in shown
    assert BEGIN in shown
    assert END in shown


def test_only_the_text_between_the_markers_is_replaced_and_a_document_without_them_refused_at_once(
    tmp_path,
):
    document = tmp_path / "page.md"
    document.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    ReportSection(document, BEGIN, END).write("new")
    ReportSection(None, BEGIN, END).write("nowhere")
    assert document.read_text() == f"before\n{BEGIN}\nnew\n{END}\nafter\n"
    document.write_text("nothing here\n")
    with pytest.raises(UserError, match="once each"):
        ReportSection(document, BEGIN, END)
    assert document.read_text() == "nothing here\n"


def test_the_result_is_printed_and_a_users_mistake_is_one_sentence_and_status_2(capsys):
    parser = make_parser(None)
    parser.add_argument("--seed", type=int, default=0)

    def measure(options):
        if options.seed < 0:
            raise UserError("seed=-1: expected 0 or more.")
        return f"seed {options.seed}, {torch.get_num_threads()} thread"

    assert run_script(measure, parser.parse_args(["--seed", "3"])) == 0
    assert capsys.readouterr().out == "seed 3, 1 thread\n"
    assert run_script(measure, parser.parse_args(["--seed", "-1"])) == 2
    assert capsys.readouterr() == ("", "error: seed=-1: expected 0 or more.\n")
