"""The common form of all recordings, and text tables on their way to it, with every error traced to
its line.

A recording is a polars frame of tracks in SI units, one row per vehicle and frame (:data:`SCHEMA`),
sorted by scene, vehicle and frame. A car that leaves the recorded road and returns has several
tracks; their numbers differ by multiples of :data:`TRACK_STRIDE`.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, SupportsInt

import polars as pl

from ganlane.errors import UserError
from ganlane.settings.generator import BLOCK_BYTES

FRAME_S: Final = 0.1
TRACK_STRIDE: Final = 10_000
#: Columns in order, with their types.
SCHEMA: Final = pl.Schema(
    {
        "scene": pl.String(),  # one recording; scenes are independent of each other
        # number of the track in its scene; ``vehicle % TRACK_STRIDE`` is the car
        "vehicle": pl.Int64(),
        "frame": pl.Int64(),  # frame number; frames are 0.1 s apart
        # centre of the body along the road, m, growing in the direction of travel
        "x": pl.Float64(),
        # centre of the body across the road, m, positive to the left; 0 at lane 0's centre
        "y": pl.Float64(),
        "speed": pl.Float64(),  # m/s, as recorded
        # as recorded; 0 is the scene's rightmost, its centre is at ``lane * lane_width``
        "lane": pl.Int64(),
        "length": pl.Float64(),  # m
        "width": pl.Float64(),  # m
    }
)
#: Columns that identify a track.
TRACK: Final = ("scene", "vehicle")
#: Bounds that no recording of road traffic in SI units exceeds.
MAX_MEDIAN_SPEED_MPS: Final = 60.0
MAX_MEDIAN_LENGTH_M: Final = 12.0
MAX_SPEED_RATIO: Final = 1.4
#: Column of a text table that holds each row's line number in the file.
LINE: Final = "line"
#: Line of the first row of data below a header, which is line 1.
FIRST_LINE: Final = 2
#: ``1,118,846,980,200``: commas that separate thousands, unlike a decimal comma.
_THOUSANDS: Final = r"^[+-]?\d{1,3}(,\d{3})+(\.\d*)?$"
Kind = pl.DataType | type[pl.DataType]
#: Called with the bytes done so far and the total, None where the total is unknown.
OnProgress = Callable[[int, int | None], None]


@dataclass(frozen=True)
class Scene:
    """One recording in the schema, sorted, with the width of its lanes in metres."""

    name: str
    frame: pl.DataFrame
    lane_width_m: float

    @property
    def lanes(self) -> int:
        """Number of lanes: the highest lane number plus one."""
        return int(self.frame["lane"].max()) + 1  # type: ignore[arg-type]


@dataclass
class RowCount:
    """Number of rows read from files, before any interpolation, and how many were dropped for which
    reason.
    """

    read: int = 0
    dropped: Counter[str] = field(default_factory=Counter)

    @property
    def kept(self) -> int:
        """Rows read and not dropped."""
        return self.read - self.dropped.total()

    def drop(self, reason: str, rows: SupportsInt) -> None:
        """Count ``rows`` dropped for ``reason``."""
        if int(rows):
            self.dropped[reason] += int(rows)


def sort(frame: pl.DataFrame) -> pl.DataFrame:
    """Rows sorted by scene, vehicle and frame."""
    return frame.sort("scene", "vehicle", "frame")


def number_tracks(frame: pl.DataFrame, source: str) -> pl.DataFrame:
    """Split each car's rows into tracks without a missing frame; one scene, sorted by ``vehicle``
    and ``frame``.

    A car's second track is numbered ``vehicle + TRACK_STRIDE``, its third
    ``vehicle + 2 TRACK_STRIDE``.

    Raises:
        UserError: a vehicle number is negative or not below :data:`TRACK_STRIDE`.
    """
    low, high = frame.select(low=pl.col("vehicle").min(), high=pl.col("vehicle").max()).row(0)
    if low < 0 or high >= TRACK_STRIDE:
        raise UserError(
            f"{source}: vehicle numbers from {low} to {high}; expected 0 to {TRACK_STRIDE - 1}, number them anew."
        )
    gap = (pl.col("frame").diff() != 1) & (pl.col("vehicle").diff() == 0)
    track = gap.fill_null(False).cast(pl.Int64).cum_sum().over("vehicle")
    return frame.with_columns(vehicle=pl.col("vehicle") + TRACK_STRIDE * track)


def validate(frame: pl.DataFrame, source: str, first_line: int | None = FIRST_LINE) -> pl.DataFrame:
    """Check a frame against the schema and return its columns in order; rows are unchanged.

    Args:
        frame: rows in the order of the file they come from.
        source: name of the file, for messages.
        first_line: line of the file that holds the first row; None where rows are not lines (they
            count from 0).

    Raises:
        UserError: a missing column, no rows, NaN or null, a frame number that does not grow within
            its track, a size of 0 or less, or units that cannot be metres and metres per second.
    """
    missing = [name for name in SCHEMA if name not in frame.columns]
    if missing:
        raise UserError(f"{source}: no column {', '.join(missing)}; expected {', '.join(SCHEMA)}.")
    if frame.is_empty():
        raise UserError(f"{source}: no rows; a recording with at least one vehicle was expected.")
    for name, kind in SCHEMA.items():
        try:
            frame = frame.with_columns(frame[name].cast(kind))
        except pl.exceptions.PolarsError as error:
            raise UserError(
                f"{source}, column {name}: {frame[name].dtype} found, {kind} expected."
            ) from error

    def place(row: int) -> str:
        return (
            f"{source}, row {row}" if first_line is None else f"{source}, line {row + first_line}"
        )

    frame = frame.select(SCHEMA.names())
    _check_rows(frame, place)
    _check_units(frame, place)
    return frame


def _check_rows(frame: pl.DataFrame, place: Callable[[int], str]) -> None:
    """Errors that one row, or one row and its predecessor in the track, are enough to show."""
    step = pl.col("frame").diff().over(TRACK)
    right: list[tuple[str, str, pl.Expr]] = [
        *(
            (name, "is not a finite number", pl.col(name).is_finite())
            for name in ("x", "y", "speed")
        ),
        *(
            (name, "is missing", pl.col(name).is_not_null())
            for name in ("scene", "vehicle", "frame", "lane")
        ),
        *((name, "is not above 0", pl.col(name) > 0.0) for name in ("length", "width")),
        # The first frame of a track has no step.
        ("frame", "comes twice in its track", (step != 0).fill_null(True)),
        (
            "frame",
            "is before its track's last frame; frames must grow",
            (step >= 0).fill_null(True),
        ),
    ]
    for column, what, expression in right:
        rows = frame.select((~expression.fill_null(False)).arg_true()).to_series()
        if len(rows):
            raise UserError(f"{place(rows[0])}, column {column}: {frame[column][rows[0]]} {what}.")


def _check_units(frame: pl.DataFrame, place: Callable[[int], str]) -> None:
    """Frames, positions, speeds or sizes that cannot be in 0.1 s and metres.

    The first row that shows it is named.
    """
    frames = pl.col("frame").diff().over(TRACK)
    # With most rows further apart than a frame, nothing could be measured between them.
    steps = frame.select("scene", step=frames).with_row_index("row")
    far = steps.filter((pl.col("step").median().over("scene") > 1) & (pl.col("step") > 1)).head(1)
    for row, scene, step in far.iter_rows():
        raise UserError(
            f"{place(row)}, column frame: most rows of scene {scene} come {step} frames after their track's last "
            f"one; expected {1 / FRAME_S:.0f} frames a second, numbered one by one: resample the recording."
        )
    rates = pl.col("x").diff().over(TRACK) / (frames * FRAME_S)
    speed, length, rate = frame.select(pl.col("speed", "length").median(), rate=rates.median()).row(
        0
    )
    for column, median, bound, unit in (
        ("speed", speed, MAX_MEDIAN_SPEED_MPS, "m/s; convert to m/s"),
        ("length", length, MAX_MEDIAN_LENGTH_M, "m; convert feet to m"),
    ):
        if median > bound:
            row = int((frame[column] > bound).arg_max() or 0)
            raise UserError(
                f"{place(row)}, column {column}: the median is {median:.1f}, which cannot be {unit}."
            )
    if rate is None or max(abs(rate), abs(speed)) < 1.0:
        return
    if not speed / MAX_SPEED_RATIO < rate < speed * MAX_SPEED_RATIO:
        agrees = rates.is_between(
            pl.col("speed") / MAX_SPEED_RATIO, pl.col("speed") * MAX_SPEED_RATIO
        )
        row = frame.select((~agrees).fill_null(False).arg_true().first()).item()
        raise UserError(
            f"{place(int(row or 0))}, columns x and speed: x moves by {rate:.1f} m per second where speed says "
            f"{speed:.1f} m/s; expected metres along the direction of travel, m/s and {1 / FRAME_S:.0f} frames a "
            "second."
        )


@dataclass(frozen=True)
class TextTable:
    """Layout of a text table; ``names`` are those of its columns, in lower case.

    With ``blanks``, runs of blanks separate the columns, instead of a comma.
    """

    path: Path
    names: tuple[str, ...]
    has_header: bool = True
    blanks: bool = False


def read_table(path: str | Path, columns: Mapping[str, Kind]) -> pl.DataFrame:
    """The named ``columns`` of a CSV file, typed by :func:`convert`, and ``line``; rows in the
    order of the file.

    Raises:
        UserError: no such file, no text table, no rows, a missing column or a wrong field; the
            message names file, line and column.
    """
    path = Path(path)
    blocks = [
        pl.DataFrame(
            [*(convert(text, name, kind, path) for name, kind in columns.items()), text[LINE]]
        )
        for text in read_blocks(csv_table(path, columns), list(columns))
    ]
    if not blocks:
        raise UserError(f"{path}: a header but no rows; give a file with at least one row of data.")
    return pl.concat(blocks)


def csv_table(path: Path, wanted: Iterable[str]) -> TextTable:
    """Layout of a CSV file according to its header line, which must hold the ``wanted`` columns in
    any case.
    """
    names = tuple(name.strip().lower() for name in _fields(first_line(path), f"{path}, line 1"))
    missing = [name for name in wanted if name not in names]
    if missing:
        raise UserError(
            f"{path}, line 1: no column {', '.join(missing)}; found {', '.join(names)}; expected {', '.join(wanted)}."
        )
    return TextTable(path, names)


def first_line(path: Path) -> str:
    """The first line of a text file, without a byte order mark."""
    if not path.is_file():
        raise UserError(f"{path}: no such file; give the path of a text table.")
    with path.open("rb") as file:
        raw = file.readline(2**16)
    try:
        text = raw.decode("utf-8-sig").strip()
    except UnicodeDecodeError as error:
        raise UserError(
            f"{path}, line 1: not text ({error.reason}); give an unpacked text or CSV file."
        ) from error
    if not text:
        raise UserError(f"{path}: the file is empty; a table of text was expected.")
    return text


def reason(error: Exception) -> str:
    """The first line of a library's error message, to be quoted inside one of ours."""
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(". ")


def convert(
    text: pl.DataFrame, column: str, kind: Kind, path: Path, thousands: bool = False
) -> pl.Series:
    """A ``column`` of text as ``String``, ``Int64`` (``3.0`` counts as a whole number) or
    ``Float64`` (finite).

    ``thousands``: whether commas may separate thousands.

    Raises:
        UserError: a field is empty or not what was expected; the first one is named by file, line
            and column.
    """
    text = text.select(pl.col(column).str.strip_chars(), LINE)
    field = text[column]
    raise_where(
        field.is_null() | (field == ""), text, column, path, "is empty; the row is incomplete"
    )
    if kind == pl.String:
        return field
    if thousands:
        # Any other comma stays, so that the field is reported as no number.
        without = pl.col(column).str.replace_all(",", "", literal=True)
        separated = pl.when(pl.col(column).str.contains(_THOUSANDS)).then(without).otherwise(column)
        field = text.select(separated.alias(column))[column]
    numbers = field.cast(pl.Float64, strict=False)
    raise_where(numbers.is_null(), text, column, path, "is not a number")
    raise_where(~numbers.is_finite(), text, column, path, "is not a finite number")
    if kind == pl.Int64:
        raise_where(numbers != numbers.round(), text, column, path, "is not a whole number")
        raise_where(numbers.abs() >= 2.0**63, text, column, path, "is too large a number")
    return numbers.cast(kind)


def raise_where(bad: pl.Series, rows: pl.DataFrame, column: str, path: Path, what: str) -> None:
    """Raise a UserError that names the first of the ``rows`` (with ``line``) that is ``bad``.

    Null is not bad.
    """
    if bad.any():
        row = rows.row(bad.fill_null(False).arg_max(), named=True)  # type: ignore[arg-type]
        field = "the field" if row[column] in (None, "") else repr(row[column])
        raise UserError(
            f"{path}, line {row[LINE]}, column {column}: {field} {what}; correct or remove the row."
        )


def read_blocks(
    table: TextTable,
    wanted: Sequence[str],
    block_bytes: int = BLOCK_BYTES,
    on_progress: OnProgress | None = None,
) -> Iterator[pl.DataFrame]:
    """The ``wanted`` columns as text, and ``line``, block by block; rows in the order of the file.

    Raises:
        UserError: a row that does not fit, is not text, empty or cut off; the message names file
            and line.
    """
    number = FIRST_LINE if table.has_header else 1
    done, total = 0, table.path.stat().st_size
    for block, has_no_end in _whole_lines(table, block_bytes):
        place = f"{table.path}, line {number}"
        # A last line without a line break is a row only if it has all its fields.
        if has_no_end:
            found, expected = (
                len(_fields(block.decode(errors="replace"), place, table.blanks)),
                len(table.names),
            )
            if found < expected:
                raise UserError(
                    f"{place}, column {table.names[max(found - 1, 0)]}: the file breaks off here, {found} of "
                    f"{expected} columns into the row; copy or download it again."
                )
        rows = block.count(b"\n") + (not block.endswith(b"\n"))
        yield _parse(table, block, wanted, number, rows)
        number += rows
        done += len(block)
        if on_progress is not None:
            on_progress(done, total)


def _whole_lines(table: TextTable, block_bytes: int) -> Iterator[tuple[bytes, bool]]:
    """Blocks of whole lines; true for a last line without a line break.

    Empty lines at the end are left out.
    """
    with table.path.open("rb") as file:
        if table.has_header:
            file.readline()
        rest = b""
        while read := file.read(block_bytes):
            together = rest + read
            # The last non-empty line is held back: it may be the file's last.
            cut = together.rstrip().rfind(b"\n") + 1
            if cut:
                yield together[:cut], False
            rest = together[cut:]
        if rest.strip():
            yield rest.rstrip(), not rest.endswith(b"\n")


def _fields(line: str, place: str, blanks: bool = False) -> list[str]:
    try:
        return line.split() if blanks else next(csv.reader([line]), [])
    except csv.Error as error:
        raise UserError(
            f"{place}: not a line of CSV ({reason(error).partition(' - ')[0]}); correct or remove it."
        ) from error


def _parse(
    table: TextTable, block: bytes, wanted: Sequence[str], number: int, rows: int
) -> pl.DataFrame:
    """One block of ``rows`` lines, the first of which is line ``number``."""
    separator = b","
    if table.blanks:
        # One blank between the fields of each line, none at its ends.
        separator, block = b" ", block.replace(b"\r\n", b"\n").replace(b"\t", b" ")
        while b"  " in block:
            block = block.replace(b"  ", b" ")
        block = block.replace(b"\n ", b"\n").replace(b" \n", b"\n").strip(b" ")
    # Columns are named by their position while parsing, since a file may use a name twice.
    columns = [b"c%d" % k for k in range(len(table.names))]
    places = {f"c{table.names.index(name)}": name for name in wanted}
    # The parser does not check columns that it skips, so extra fields are found by counting
    # separators.
    has_quotes = b'"' in block
    if not has_quotes and block.count(separator) != rows * (len(columns) - 1):
        _raise_at_bad_line(table, block, number)
    try:
        frame = pl.read_csv(
            separator.join(columns) + b"\n" + block,
            separator=separator.decode(),
            infer_schema=False,
            columns=None if has_quotes else list(places),
        )
    except (pl.exceptions.PolarsError, UnicodeDecodeError) as error:
        _raise_at_bad_line(table, block, number)
        raise UserError(
            f"{table.path}, from line {number}: not a readable table ({error})."
        ) from error
    if frame.height != rows:
        _raise_at_bad_line(table, block, number)
        raise UserError(f"{table.path}, from line {number}: a row stretches over several lines.")
    lines = pl.int_range(number, number + rows, dtype=pl.Int64).alias(LINE)
    return frame.select(*(pl.col(place).alias(name) for place, name in places.items()), lines)


def _raise_at_bad_line(table: TextTable, block: bytes, number: int) -> None:
    """Look for the first line that does not fit the table."""
    expected = len(table.names)
    for line, raw in enumerate(block.removesuffix(b"\n").split(b"\n"), number):
        place = f"{table.path}, line {line}"
        if not raw.strip():
            raise UserError(f"{place}: the line is empty; remove it.")
        try:
            text = raw.decode()
        except UnicodeDecodeError as error:
            raise UserError(
                f"{place}: the line is not text; copy or download the file again."
            ) from error
        if raw.count(b'"') % 2:
            raise UserError(
                f"{place}: a quotation mark without its counterpart; correct or remove the row."
            )
        found = len(_fields(text, place, table.blanks))
        if found > expected:
            raise UserError(
                f"{place}: {found} fields, expected {expected}; correct or remove the row."
            )
        if found < expected:
            column = table.names[found - 1]
            raise UserError(
                f"{place}, column {column}: the row ends after {found} of {expected} fields; correct or remove it."
            )
