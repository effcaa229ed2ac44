"""The tables of README and docs, made again from the committed results, and the figures around
them.
"""

from __future__ import annotations

import shutil

import pytest

from benchmarks import printed
from ganlane.errors import UserError


@pytest.fixture(scope="module")
def results():
    return printed.load()


@pytest.fixture
def documents(tmp_path):
    """A copy of the documents that a test may change."""
    for name in {document for document, _ in [*printed.SECTIONS, *printed.CHECKED]}:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(printed.ROOT / name, tmp_path / name)
    return tmp_path


def test_every_table_and_figure_in_the_documents_is_that_of_the_committed_results(results):
    assert printed.differences(results) == []


def test_another_digit_in_a_table_is_found(results, documents):
    document = "README.md"
    path = documents / document
    begin, end = printed.markers(
        next(name for place, name in printed.SECTIONS if place == document)
    )
    text = path.read_text(encoding="utf-8")
    table = text[text.index(begin) : text.index(end)]
    digit = next(place for place in range(len(table) - 1, 0, -1) if table[place].isdigit())
    changed = f"{table[:digit]}{(int(table[digit]) + 1) % 10}{table[digit + 1 :]}"
    path.write_text(text.replace(table, changed), encoding="utf-8")
    assert any(document in line for line in printed.differences(results, documents))


def test_a_figure_with_an_interval_is_one_of_the_results_rounded_as_it_is_printed(results):
    row = next(row for row in results["rows"] if row["minus_mobil_ci"])
    low, high = row["minus_mobil_ci"]
    right = f"{row['minus_mobil']:.1f} [{low:.1f}, {high:.1f}]"
    turned_round = f"{-row['minus_mobil']:.1f} [{-high:.1f}, {-low:.1f}]"
    wrong = f"{row['minus_mobil']:.1f} [{low:.1f}, {high + 0.1:.1f}]"
    assert printed.unsourced(f"It leads by {right}, or trails by {turned_round}.", results) == []
    assert printed.unsourced(f"It leads by {wrong}.", results) == [wrong]


def test_the_results_name_their_command_revision_seeds_and_machine(results):
    assert results["command"].startswith("ganlane reproduce ")
    assert results["cells"]["revisions"]
    assert {"stream", "seed", "episodes"} <= results["seeds"].keys()
    assert results["machine"]


def test_a_section_that_is_gone_is_named():
    with pytest.raises(UserError, match="## Results: no such section"):
        printed.section("# Title\n\ntext\n", "## Results")
    assert printed.section("## Results\na\n### b\nc\n## Next\nd", "## Results") == "\na\n### b\nc\n"
