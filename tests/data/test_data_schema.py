"""Text tables, whose rows, line numbers and errors do not depend on the size of a block, and the
validator.
"""

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.refusals import user_error
from reference.synthetic import synthetic_scenes

from ganlane.data.schema import validate
from ganlane.data.tables import LINE, TextTable, convert, csv_table, read_blocks


def read(folder, content, blanks=False, block_bytes=2**20):
    path = folder / "t.csv"
    path.write_bytes(content)
    table = TextTable(path, ("a", "b", "c"), blanks=blanks)
    return pl.concat(read_blocks(table, ["c", "a"], block_bytes))


@settings(max_examples=30)
@given(
    rows=st.lists(st.tuples(*[st.integers(-999, 999)] * 3), min_size=1, max_size=12),
    block_bytes=st.integers(1, 60),
    blanks=st.booleans(),
    windows=st.booleans(),
    ended=st.booleans(),
)
def test_the_size_of_a_block_changes_nothing(
    tmp_path_factory, rows, block_bytes, blanks, windows, ended
):
    # Blanks and tabs of any number, or commas.
    lines = [("  {}   {}\t{} " if blanks else "{},{},{}").format(*row) for row in rows]
    end = "\r\n" if windows else "\n"
    content = end.join([*([] if blanks else ["a,b,c"]), *lines]) + (end if ended else "")
    parsed = read(tmp_path_factory.mktemp("blocks"), content.encode(), blanks, block_bytes)
    first = 1 if blanks else 2
    numbers = [tuple(map(int, (c, a))) for c, a, _ in parsed.select("c", "a", LINE).iter_rows()]
    assert numbers == [(c, a) for a, _, c in rows]
    assert parsed[LINE].to_list() == list(range(first, first + len(rows)))


@pytest.mark.parametrize("block_bytes", [3, 2**20])
@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["1,2,3", "4,5", "7,8,9"], r"line 3, column b: the row has 2 fields, expected 3"),
        (["1,2,3", "4,5,6,6", "7,8,9"], r"line 3, column c: the row has 4 fields, expected 3"),
        (["1,2,3", "", "7,8,9"], r"line 3: the line is empty"),
        (["1,2,3", '4,"5,6', "7,8,9"], r"line 3: a quotation mark without its counterpart"),
        (["1,2,3", "4,5,6", "7,8"], r"line 4, column b: the row has 2 fields, expected 3"),
        (["1,2,3", "4,5,\xff\xfe"], r"t.csv, line 3: the line is not text"),
    ],
)
def test_a_row_that_does_not_fit_is_named_by_its_line(tmp_path, lines, message, block_bytes):
    # Bytes that are no UTF-8 get through as latin-1.
    content = "\n".join(["a,b,c", *lines, ""]).encode("latin-1")
    with user_error(message):
        read(tmp_path, content, block_bytes=block_bytes)


@pytest.mark.parametrize("content", [b"\xef\xbb\xbf", b"\xef\xbb\xbf\n1,2,3\n", b"\x1c\n"])
def test_a_first_line_of_invisible_characters_is_an_empty_file(tmp_path, content):
    (tmp_path / "t.csv").write_bytes(content)
    with user_error(r"t.csv: the file is empty"):
        csv_table(tmp_path / "t.csv", ["a"])


def test_foreign_line_breaks_are_refused_with_their_line(tmp_path):
    with user_error(r"t.csv, line 3: not a line of CSV"):
        read(tmp_path, b"a,b,c\n1,2,3\n4,5\r6,7,8\n")
    # Line breaks of an old Macintosh make one line of the whole file.
    (tmp_path / "t.csv").write_bytes(b"a,b,c\r1,2,3\r4,5,6\r")
    with user_error(r"t.csv, line 1: not a line of CSV"):
        csv_table(tmp_path / "t.csv", ["a"])


def test_quoted_fields_may_hold_commas(tmp_path):
    parsed = read(tmp_path, b'a,b,c\n"1,234",2,"5,678.25"\n7,8,9\n')
    assert convert(parsed, "c", pl.Float64, tmp_path).to_list() == [5678.25, 9.0]


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        *((text, pl.Float64, "is not a number") for text in ("1,23", "1,2345", "1.234,5")),
        ("NaN", pl.Float64, "'NaN' is not a finite number"),
        ("", pl.String, "the field is empty; the row is incomplete"),
        ("5.5", pl.Int64, "'5.5' is not a whole number"),
        *((text, pl.Int64, "is too large a number") for text in ("1e30", "-1e308", str(2**63))),
    ],
)
def test_a_wrong_field_is_named_by_file_line_and_column(tmp_path, text, kind, message):
    # The second row, line 3, is the wrong one.
    rows = pl.DataFrame({"x": ["1", text], LINE: [2, 3]})
    with user_error(f"t.csv, line 3, column x: .*{message}"):
        convert(rows, "x", kind, tmp_path / "t.csv")


def test_a_header_is_read_in_any_case_with_quotes_and_a_byte_order_mark(tmp_path):
    path = tmp_path / "t.csv"
    path.write_bytes(b'\xef\xbb\xbf"A", B,c\n1,2,3\n')
    assert csv_table(path, ["a", "c"]).names == ("a", "b", "c")


def test_the_validator_checks_frames_that_come_from_nowhere():
    frame = synthetic_scenes(scenes=1)
    assert validate(frame, "made").equals(frame)
    # A row without a position.
    holed = frame.with_columns(x=pl.when(pl.int_range(pl.len()) == 7).then(None).otherwise("x"))
    for wrong, message in (
        (frame.drop("speed"), "made: no column speed"),
        (frame.clear(), "made: no rows"),
        (frame.with_columns(x=pl.lit("here")), "made, column x: String found, Float64 expected"),
        (holed, "made, line 9, column x: None is not a finite number"),
    ):
        with user_error(message):
            validate(wrong, "made")
