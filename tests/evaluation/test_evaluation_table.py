"""Numbers and tables as a reader sees them."""

import pytest

from ganlane.evaluation.table import Table, aligned, count, fitting, percent


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (None, "-"),
        (612.4, "612"),
        (1234, "1.23 k"),
        (54321, "54.3 k"),
        (999_600, "1.00 M"),
        (2.5e9, "2.50 G"),
    ],
)
def test_counts_have_three_digits_and_a_unit(value, shown):
    assert count(value) == shown


def test_shares_are_per_cent():
    assert (percent(0.126), percent(0.126, 1), percent(None)) == ("13 %", "12.6 %", "-")


def test_a_table_aligns_words_left_and_numbers_right():
    table = Table.of(
        "Speed",
        [("a", 10), ("long", 2)],
        {"who": lambda r: r[0], "n": lambda r: str(r[1])},
        1,
        ["Said."],
    )
    assert table.text().splitlines()[2:] == [
        "who    n",
        "----  --",
        "a     10",
        "long   2",
        "",
        "Said.",
    ]
    assert (
        table.markdown()
        == "### Speed\n\n| who | n |\n| --- | ---: |\n| a | 10 |\n| long | 2 |\n\nSaid."
    )
    assert table.markdown(heading=False).startswith("| who | n |")


def test_a_narrow_terminal_gets_fewer_columns_and_a_line_that_names_the_others():
    table = aligned(
        [
            [
                "agent",
                "hard",
                "m/s",
                "last",
            ],
            [
                "mobil",
                "1",
                "22.5",
                "1234",
            ],
            [
                "a_long_name",
                "10",
                "3.0",
                "5",
            ],
        ]
    )
    text = f"a title\n\n{table}\n\na note that is longer than what the terminal has room for"
    assert fitting(text, len(table.splitlines()[1])) == text
    lines = fitting(text, 24).split("\n")
    assert lines[0] == "a title"
    assert lines[2:6] == [
        "agent        hard  last",
        "-----------  ----  ----",
        "mobil           1  1234",
        "a_long_name    10     5",
    ]
    assert lines[6] == "(columns=all shows: m/s)"
    assert lines[8].startswith("a note that is longer")
    assert fitting(text, 3).split("\n")[2] == "agent"
