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
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from ganlane.errors import ParameterError, UserError
from ganlane.settings.driving import Visibility
from ganlane.settings.record import make
from ganlane.settings.road import LaneStretch, Stretches
from ganlane.sim.scenes import FixedScene, SceneVehicle, check_count
from ganlane.sim.state import Road

#: Columns of a scene file.
COLUMNS = tuple(field.name for field in fields(SceneVehicle) if field.name != "origin")
ROAD = ("lanes", "lane_width_m")
WHOLE_NUMBERS = ("lane", "target_lane", "lanes")
LANE_WIDTH_M = 4.0
#: Larger files hold no scene, bytes; and so many signs of a value are quoted in a message.
_MOST_BYTES = 2**24
_QUOTED = 60


def read_scene(
    path: str | Path, lanes: int | None = None, lane_width_m: float | None = None
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
    road: dict[str, Any] = {}
    if path.suffix.lower() == ".csv":
        rows = _read_csv(path, text)
    else:
        rows, road = _read_json(path, text)
    # The file's numbers hold unless it gives none.
    width = _agreed(path, "lane_width_m", road, lane_width_m) or LANE_WIDTH_M
    stretches = road.get("stretches", ())
    count = _agreed(path, "lanes", road, lanes) or len(stretches) or _lanes_in(rows, width)
    if stretches and rows:
        # The ego starts at 0, wherever the file has it.
        stretches = tuple(stretch.seen_from(rows[0].x_m) for stretch in stretches)
    try:
        whole = Road(int(count), float(width), stretches=stretches)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    return FixedScene(tuple(rows), whole, name=str(path))


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
    return replace(scene, rows=(replace(ego, desired_speed_mps=desired_speed_mps), *others))


def _text(path: Path, what: str, endings: Sequence[str]) -> str:
    """The file's text; ``what`` it should hold, for messages."""
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
        try:
            stretches.append(make(LaneStretch, lane))
        except ParameterError as error:
            raise UserError(f"{where}, lane {number}: {error}") from error
    return tuple(stretches)


def _agreed(path: Path, name: str, road: Mapping[str, Any], wanted: float | None) -> Any:
    """The value of the file or of the caller; an error if they differ."""
    in_file = road.get(name)
    if in_file is not None and wanted is not None and in_file != wanted:
        raise UserError(
            f"{path}: {name} is {in_file:g} in the file and {wanted:g} was asked for; "
            "leave one of them out."
        )
    return wanted if in_file is None else in_file


def _lanes_in(rows: list[SceneVehicle], lane_width_m: float) -> int:
    """Just enough lanes for all vehicles and their target lanes."""
    highest = 0
    for row in rows:
        lane = row.lane
        if lane is None:
            # Off every centre: the nearest lane counts.
            lane = round((row.y_m or 0.0) / lane_width_m)
        highest = max(highest, lane, row.target_lane or 0)
    return 1 + highest


def _read_csv(path: Path, text: str) -> list[SceneVehicle]:
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
    where, _, line = lines[0]
    # The first line that is no comment.
    header = _cells(line, where)
    _check_names(header, where)
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
        rows.append(_row(values, where, origin))
    return rows


def _cells(line: str, where: str) -> list[str]:
    try:
        # Line by line, so that a mistake has a line number; no cell spans two lines.
        return [cell.strip() for cell in next(csv.reader([line]))]
    except csv.Error as error:
        raise UserError(f"{where}: not a line of CSV ({error}); fix the line.") from error


def _read_json(path: Path, text: str) -> tuple[list[SceneVehicle], dict[str, Any]]:
    """The vehicles, and what the file says of the road."""
    content = _json(path, text)
    # A bare list of vehicles is short for an object without a road.
    if isinstance(content, list):
        content = {"vehicles": content}
    if not isinstance(content, dict) or not isinstance(content.get("vehicles"), list):
        raise UserError(
            f"{path}: expected a list of vehicles, or an object with 'vehicles'; "
            "see docs/scenarios.md."
        )
    vehicles = content.pop("vehicles")
    check_count(str(path), len(vehicles))
    rows = []
    for number, vehicle in enumerate(vehicles, 1):
        where = f"{path}: vehicles entry {number}"
        if not isinstance(vehicle, dict):
            raise UserError(f"{where}: expected an object with {', '.join(COLUMNS)}.")
        _check_names(list(vehicle), where)
        values = {name: value for name, value in vehicle.items() if value is not None}
        rows.append(_row(values, where, f"entry {number}"))
    # What is left are keys of the road.
    road: dict[str, Any] = {}
    if content.get("stretches") is not None:
        road["stretches"] = _stretches(content.pop("stretches"), f"{path}: stretches")
    for name in sorted(content):
        if name not in ROAD:
            raise UserError(
                f"{path}: unknown key {_quoted(name)}; expected lanes, lane_width_m, stretches and "
                "vehicles."
            )
    for name in ROAD:
        if content.get(name) is not None:
            road[name] = value = _value(name, content[name], f"{path}: {name}")
            if not 0 < value < float("inf"):
                raise UserError(f"{path}: {name}={value}: expected a finite number above 0.")
    return rows, road


def _check_names(names: Sequence[str], where: str) -> None:
    """Check that column names are known and unique."""
    for name in names:
        if name not in COLUMNS:
            unknown = _quoted(name) if name else "(empty)"
            raise UserError(
                f"{where}: unknown column {unknown}; expected some of {', '.join(COLUMNS)}."
            )
        if names.count(name) > 1:
            raise UserError(f"{where}: column {name} is given twice; remove one.")


def _row(values: Mapping[str, Any], where: str, origin: str) -> SceneVehicle:
    """A vehicle from its values in a file."""
    if "x_m" not in values:
        raise UserError(f"{where}: column x_m: no value; give the position along the road in m.")
    numbers = {}
    for name, value in values.items():
        numbers[name] = _value(name, value, f"{where}: column {name}")
    return SceneVehicle(**numbers, origin=origin)


def _value(name: str, value: Any, where: str) -> Any:
    """A number, or a :class:`Visibility`, from what stands in a file."""
    if name == "visibility":
        kinds = {kind.name.lower(): kind for kind in Visibility}
        if not isinstance(value, str) or value not in kinds:
            raise UserError(f"{where}: {_quoted(value)}: expected one of {', '.join(kinds)}.")
        return kinds[value]
    # CSV has texts, JSON numbers: both go through float.
    whole = name in WHOLE_NUMBERS
    try:
        if isinstance(value, bool):  # JSON's true, which Python takes for a 1
            raise ValueError
        number = float(value)
        if whole and number != int(number):
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        kind = "a whole number" if whole else "a number"
        raise UserError(f"{where}: {_quoted(value)}: expected {kind}.") from None
    return int(number) if whole else number


def _quoted(value: Any) -> str:
    """The value in a message, cut where it is long."""
    text = repr(value)
    return text if len(text) <= _QUOTED else f"{text[:_QUOTED]}..."
