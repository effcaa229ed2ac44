"""Scenes from files, CSV or JSON; m, m/s, and the ego comes first.

CSV has a header, a line per vehicle and these columns, of which ``x_m`` and ``lane`` (or ``y_m``)
are required; lines that start with ``#`` are skipped, and an empty cell means the default::

    x_m, lane, y_m, speed_mps, desired_speed_mps, length_m, width_m, target_lane, visibility

JSON is a list of objects with the same names, or
``{"lanes": 3, "lane_width_m": 4.0, "stretches": [...], "vehicles": [...]}``, where ``stretches``
has an object for each lane from the right, with the fields of
:class:`~ganlane.settings.road.LaneStretch`. Every mistake is named by file, line (or entry) and
column.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from ganlane.errors import ParameterError, UserError, as_typed
from ganlane.settings.driving import Visibility
from ganlane.settings.record import Count, Positive, Record, key_names, make
from ganlane.settings.road import LaneStretch, Stretches
from ganlane.sim.scenes import FixedScene, SceneVehicle, SceneVehicles, check_count
from ganlane.sim.state import Road

Made = TypeVar("Made")
#: Columns of a scene file.
COLUMNS = key_names(SceneVehicle)
LANE_WIDTH_M = 4.0
#: Larger files hold no scene, bytes.
_MOST_BYTES = 2**24


@dataclass(frozen=True)
class SceneFile(Record):
    """What a file says of a scene; None and empty: nothing.

    Attributes:
        vehicles: the ego first.
        lanes: of its road.
        lane_width_m: of its road, m.
        stretches: where its lanes begin and end, from the right, m.
    """

    vehicles: SceneVehicles
    lanes: Count | None = None
    lane_width_m: Positive | None = None
    stretches: Stretches = ()


def read_scene(
    path: str | Path,
    lanes: int | None = None,
    lane_width_m: float | None = None,
) -> FixedScene:
    """The scene in a CSV or JSON file; ``replace`` sets its jitter and visibility.

    Args:
        path: the file; its ending gives the format.
        lanes: number of lanes; None: as in the file, or just enough for its vehicles.
        lane_width_m: m; None: as in the file, or 4.

    Raises:
        UserError: no such file, not CSV or JSON, a wrong column or value (named by file, line and
            column), a road other than the file's, or an impossible scene.
    """
    path = Path(path)
    text = _text(path, "a scene", (".csv", ".json"))
    file = _read_csv(path, text) if path.suffix.lower() == ".csv" else _read_json(path, text)
    rows = file.vehicles
    stretches = file.stretches

    # Width and lanes as in the file or as asked for; without either, what fits.
    width = _agreed(path, "lane_width_m", file.lane_width_m, lane_width_m) or LANE_WIDTH_M
    count = _agreed(path, "lanes", file.lanes, lanes) or len(stretches) or _lanes_in(rows, width)

    if rows:
        # The ego starts at 0, wherever the file has it.
        stretches = tuple(stretch.seen_from(rows[0].x_m) for stretch in stretches)

    try:
        road = Road(int(count), float(width), stretches=stretches)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    return FixedScene(rows, road, name=str(path))


def read_roads(path: str | Path) -> dict[str, Stretches]:
    """Where the lanes of recorded scenes begin and end, by the names of the scenes.

    JSON: ``{"SCENE": [...], ...}`` with an object for each lane of the scene, from the right, as in
    the ``stretches`` of a scene's file. Positions are those of the recording, m.

    Raises:
        UserError: no such file, not JSON, or a wrong value (named by file, scene and lane).
    """
    path = Path(path)
    content = _json(path, _text(path, "roads", (".json",)))
    if not isinstance(content, dict):
        raise UserError(f"{path}: expected an object of scenes; see docs/traffic.md.")

    return {scene: _stretches(lanes, f"{path}: {scene}") for scene, lanes in content.items()}


def with_ego_speed(scene: FixedScene, desired_speed_mps: float) -> FixedScene:
    """The scene with another desired speed of the ego, m/s."""
    ego, *others = scene.rows
    ego = replace(ego, desired_speed_mps=desired_speed_mps)
    return replace(scene, rows=(ego, *others))


def _text(path: Path, what: str, endings: Sequence[str]) -> str:
    """The file's text.

    Args:
        path: the file.
        what: it should hold, for messages.
        endings: its name may have.

    Raises:
        UserError: no such file, another ending, too large, or not UTF-8.
    """
    expected = " or ".join(endings)
    if not path.is_file():
        raise UserError(f"{path}: no such file; give {what} as {expected}.")
    # Endings are checked before anything is read.
    if path.suffix.lower() not in endings:
        raise UserError(f"{path}: expected {what} as {expected}; rename or convert the file.")
    # A film given by mistake is not read into memory.
    if path.stat().st_size > _MOST_BYTES:
        raise UserError(
            f"{path}: more than {_MOST_BYTES} bytes, too much for {what}; give a smaller file."
        )

    try:
        # utf-8-sig, since spreadsheets write a byte order mark.
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise UserError(
            f"{path}: not a text file in UTF-8 ({error.reason}); save it as one."
        ) from error


def _json(path: Path, text: str) -> Any:
    """What JSON says; raises :class:`UserError` for other text."""
    try:
        return json.loads(text)
    # A ValueError without a place in the file: a whole number of thousands of digits.
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not JSON ({error}); fix the file.") from error


def _stretches(lanes: Any, where: str) -> Stretches:
    """The stretches of a road's lanes, from the right."""
    if not isinstance(lanes, list) or not lanes:
        raise UserError(f"{where}: expected a list with an object for each lane, from the right.")

    stretches = []
    for number, lane in enumerate(lanes):
        stretches.append(_made(LaneStretch, lane, f"{where}, lane {number}"))
    return tuple(stretches)


def _made(kind: type[Made], values: Any, where: str) -> Made:
    """A record of what a file has at a place; raises :class:`UserError` for wrong values."""
    if not isinstance(values, dict):
        raise UserError(f"{where}: expected an object with {', '.join(key_names(kind))}.")

    # Null is as no value.
    numbers = {name: _number(value) for name, value in values.items() if value is not None}
    try:
        return make(kind, numbers)
    except ParameterError as error:
        raise UserError(f"{where}: {error}") from error


def _number(value: Any) -> Any:
    """The number that a text says (CSV has texts alone); all else as it is."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _agreed(path: Path, name: str, in_file: float | None, wanted: float | None) -> float | None:
    """The value of the file or of the caller; an error if they differ."""
    if in_file is not None and wanted is not None and in_file != wanted:
        raise UserError(
            f"{path}: {name} is {in_file:g} in the file and {wanted:g} was asked for; "
            "leave one of them out."
        )
    return wanted if in_file is None else in_file


def _lanes_in(rows: Sequence[SceneVehicle], lane_width_m: float) -> int:
    """Just enough lanes for all vehicles and their target lanes."""
    highest = 0
    for row in rows:
        lane = row.lane
        if lane is None:
            # Off every centre: the nearest lane counts.
            lane = round((row.y_m or 0.0) / lane_width_m)
        highest = max(highest, lane, row.target_lane or 0)
    return 1 + highest


def _read_csv(path: Path, text: str) -> SceneFile:
    """A scene from CSV: a header, then a line per vehicle."""
    # Lines with something in them: where they are, in messages and in labels, and what they say.
    lines = []
    # Numbers of lines count comments and empty lines too, as an editor does.
    for number, line in enumerate(text.split("\n"), 1):
        if line.strip() and not line.lstrip().startswith("#"):
            lines.append((f"{path}: line {number}", f"line {number}", line))
    if not lines:
        raise UserError(
            f"{path}: empty; expected a header with {', '.join(COLUMNS)}, and a line per vehicle."
        )
    check_count(str(path), len(lines) - 1)

    # The first line that is no comment.
    where, _, line = lines[0]
    header = _cells(line, where)
    for name in header:
        if name not in COLUMNS:
            raise UserError(
                f"{where}: unknown column {name!r:.60}; expected some of {', '.join(COLUMNS)}."
            )
        if header.count(name) > 1:
            raise UserError(f"{where}: column {name} is given twice; remove one.")
    if "x_m" not in header or not {"lane", "y_m"} & set(header):
        raise UserError(
            f"{where}: columns x_m and lane (or y_m) are needed; the header has "
            f"{', '.join(header)}."
        )

    rows = []
    for where, origin, line in lines[1:]:
        cells = _cells(line, where)
        if len(cells) != len(header):
            raise UserError(
                f"{where}: {len(cells)} cells, the header has {len(header)}; fix the line."
            )

        # An empty cell is as a column that is not there: the default.
        values = {name: cell for name, cell in zip(header, cells) if cell}
        rows.append(_vehicle(values, where, origin))
    return SceneFile(tuple(rows))


def _cells(line: str, where: str) -> list[str]:
    """The cells of a line of CSV, without spaces around them."""
    try:
        # Line by line, so that a mistake has a line number; no cell spans two lines.
        return [cell.strip() for cell in next(csv.reader([line]))]
    except csv.Error as error:
        raise UserError(f"{where}: not a line of CSV ({error}); fix the line.") from error


def _read_json(path: Path, text: str) -> SceneFile:
    """A scene from JSON: a list of vehicles, or an object that has one and maybe a road."""
    content = _json(path, text)
    # A bare list of vehicles is short for an object without a road.
    if isinstance(content, list):
        content = {"vehicles": content}
    if not isinstance(content, dict) or not isinstance(content.get("vehicles"), list):
        raise UserError(
            f"{path}: expected a list of vehicles, or an object with 'vehicles'; "
            "see docs/scenarios.md."
        )
    check_count(str(path), len(content["vehicles"]))

    # The lists of objects become lists of records.
    rows = []
    for number, vehicle in enumerate(content["vehicles"], 1):
        where = f"{path}: vehicles entry {number}"
        rows.append(_vehicle(vehicle, where, f"entry {number}"))
    content["vehicles"] = rows
    if content.get("stretches") is not None:
        content["stretches"] = _stretches(content["stretches"], f"{path}: stretches")
    return _made(SceneFile, content, str(path))


def _vehicle(values: Any, where: str, origin: str) -> SceneVehicle:
    """A vehicle from its values in a file.

    Args:
        values: by the names of the columns.
        where: they are, for messages of errors here.
        origin: the same within the file, for messages about the vehicle later on.
    """
    # What is no dict is refused with the names of the columns, below.
    if isinstance(values, dict):
        if values.get("x_m") is None:
            raise UserError(f"{where}: x_m: no value; give the position along the road in m.")

        # Files name a visibility, the record has its number.
        kinds = {kind.name.lower(): kind for kind in Visibility}
        name = values.get("visibility")
        if name is not None:
            if not isinstance(name, str) or name not in kinds:
                raise UserError(
                    f"{where}: visibility={as_typed(name):.60}: expected one of {', '.join(kinds)}."
                )
            values = values | {"visibility": kinds[name]}

    vehicle = _made(SceneVehicle, values, where)
    return replace(vehicle, origin=origin)
