"""Numbers and tables as a reader sees them."""

from ganlane.evaluation.table import Table, aligned, fitting


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


def test_a_narrow_terminal_gets_fewer_columns_and_a_line_that_names_the_others():
    rows = ["agent hard m/s last", "mobil 1 22.5 1234", "a_long_name 10 3.0 5"]
    table = aligned([row.split() for row in rows])
    text = f"a title\n\n{table}\n\na note that is longer than what the terminal has room for"
    assert fitting(text, len(table.splitlines()[1])) == text
    lines = fitting(text, 24).split("\n")
    assert lines[0] == "a title"
    assert lines[2:7] == [
        "agent        hard  last",
        "-----------  ----  ----",
        "mobil           1  1234",
        "a_long_name    10     5",
        "(columns=all shows: m/s)",
    ]
    assert lines[8].startswith("a note that is longer")
    assert fitting(text, 3).split("\n")[2] == "agent"
