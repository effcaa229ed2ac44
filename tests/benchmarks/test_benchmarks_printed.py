"""The tables of README and docs, made again from the committed results, and the figures around
them.
"""

import pytest
from reference.refusals import user_error

from benchmarks import printed


@pytest.fixture(scope="module")
def results():
    return printed.load()


def test_every_table_and_figure_in_the_documents_is_that_of_the_committed_results(results):
    assert printed.differences(results) == []


def test_another_number_in_the_results_is_missed_in_the_documents(results):
    quoted = ("agent_gan+none", "gan")
    row = next(row for row in results["rows"] if (row["driver"], row["traffic"]) == quoted)
    changed = {**row, "normalized_percent": row["normalized_percent"] + 1.0}
    rows = [changed if other is row else other for other in results["rows"]]
    told = printed.differences({**results, "rows": rows})
    assert any("docs/drivers.md: the table paper differs" in line for line in told)
    assert any("is not in the results" in line for line in told)


def test_a_figure_with_an_interval_is_one_of_the_results_rounded_as_it_is_printed(results):
    row = next(row for row in results["rows"] if row["minus_mobil_ci"])
    low, high = row["minus_mobil_ci"]
    right = f"{row['minus_mobil']:.1f} [{low:.1f}, {high:.1f}]"
    turned_round = f"{-row['minus_mobil']:.1f} [{-high:.1f}, {-low:.1f}]"
    wrong = f"{row['minus_mobil']:.1f} [{low:.1f}, {high + 0.1:.1f}]"
    figures = printed.sourced(results)
    assert printed.unsourced(f"It leads by {right}, or trails by {turned_round}.", figures) == []
    assert printed.unsourced(f"It leads by {wrong}.", figures) == [wrong]


def test_the_results_name_their_command_revision_seeds_and_machine(results):
    assert results["command"].startswith("ganlane benchmark suite=paper ")
    assert results["code"]["revision"]
    assert {"stream", "seed", "episodes"} <= results["seeds"].keys()
    assert results["machine"]


def test_a_section_that_is_gone_is_named():
    with user_error("## Results: no such section"):
        printed.section("# Title\n\ntext\n", "## Results")
    assert printed.section("## Results\na\n### b\nc\n## Next\nd", "## Results") == "\na\n### b\nc\n"
