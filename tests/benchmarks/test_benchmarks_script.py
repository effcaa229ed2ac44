"""What the scripts share: a document is refused or written into, and the exit status."""

import pytest
import torch
from reference.refusals import user_error

from benchmarks.script import (
    ReportSection,
    count,
    make_parser,
    markdown,
    run_script,
)
from ganlane.errors import UserError
from ganlane.evaluation.table import Table

BEGIN, END = "<!-- begin one -->", "<!-- end one -->"


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (612.4, "612"),
        (1234, "1.23 k"),
        (54321, "54.3 k"),
        (999_600, "1.00 M"),
        (2.5e9, "2.50 G"),
    ],
)
def test_counts_have_three_digits_and_a_unit(value, shown):
    assert count(value) == shown


def test_a_table_in_markdown_has_its_title_as_a_heading_and_notes_below():
    table = Table("Speed", ["who", "n"], [["a", "10"]], 1, ["Said."])
    assert markdown(table) == "### Speed\n\n| who | n |\n| --- | ---: |\n| a | 10 |\n\nSaid."


def test_what_stands_between_the_markers_is_rewritten_and_the_rest_stays(tmp_path):
    document = tmp_path / "page.md"
    document.write_text(f"# Title\n{BEGIN}{END} tail é\n", encoding="utf-8")
    for content in ("one", "two\nlines"):
        ReportSection(document, "one").write(content)
        ReportSection(None, "one").write("nowhere")
        text = document.read_text(encoding="utf-8")
        assert text == f"# Title\n{BEGIN}\n\n{content}\n\n{END} tail é\n"


@pytest.mark.parametrize(
    "text", ["", BEGIN, END, f"{END}{BEGIN}", f"{BEGIN}{END}{END}", f"{BEGIN}{BEGIN}{END}"]
)
def test_a_document_without_both_markers_once_and_in_order_is_refused_at_once(tmp_path, text):
    document = tmp_path / "page.md"
    document.write_text(text)
    with user_error(r"page\.md: expected the lines .* once each"):
        ReportSection(document, "one")
    assert document.read_text() == text
    with user_error(r"gone\.md: no such file"):
        ReportSection(tmp_path / "gone.md", "one")
    assert list(tmp_path.iterdir()) == [document]


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
