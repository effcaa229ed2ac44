"""Scenes from a file: CSV (one line per vehicle) or JSON. The first vehicle is the ego.

CSV has a header and these columns, of which ``x_m`` and ``lane`` (or ``y_m``) are required; lines that start with
``#`` are skipped, and an empty cell means the default::

    x_m, lane, y_m, speed_mps, desired_speed_mps, length_m, width_m, target_lane, visibility

JSON is a list of objects with the same names, or ``{"lanes": 3, "lane_width_m": 4.0, "vehicles": [...]}``.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from ganlane.errors import UserError
from ganlane.parameters.driving import Visibility
from ganlane.sim.scenes import FixedScene, SceneVehicle, check_count
from ganlane.sim.state import Road

#: Columns of a scene file.
COLUMNS = tuple(field.name for field in fields(SceneVehicle) if field.name != "origin")
WHOLE_NUMBERS = ("lane", "target_lane")
LANE_WIDTH_M = 4.0
#: Larger files hold no scene, bytes; and so many signs of a value are quoted in a message.
_MOST_BYTES = 2**24
_QUOTED = 60


def read_scene(path: str | Path, lanes: int | None = None, lane_width_m: float | None = None) -> FixedScene:
    """The scene in a CSV or JSON file; ``replace`` sets its jitter and visibility.

    Args:
        path: the file; its ending gives the format.
        lanes: number of lanes; None: as in the file, or just enough for its vehicles.
        lane_width_m: m; None: as in the file, or 4.

    Raises:
        UserError: no such file, not CSV or JSON, a wrong column or value (named by file, line and column), a road
            other than the file's, or an impossible scene.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path}: no such file; give a scene as .csv or .json.")
    readers = {".csv": _read_csv, ".json": _read_json}
    if path.suffix.lower() not in readers:
        raise UserError(f"{path}: expected a scene as .csv or .json; rename or convert the file.")
    if path.stat().st_size > _MOST_BYTES:
        raise UserError(f"{path}: more than {_MOST_BYTES} bytes, which no scene has; give a smaller file.")
    try:
        rows, road = readers[path.suffix.lower()](path)
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: not a text file in UTF-8 ({error.reason}); save the scene as one.") from error
    width = _agreed(path, "lane_width_m", road.get("lane_width_m"), lane_width_m) or LANE_WIDTH_M
    count = _agreed(path, "lanes", road.get("lanes"), lanes) or _lanes_in(rows, width)
    return FixedScene(tuple(rows), Road(int(count), float(width)), name=str(path))


def with_ego_speed(scene: FixedScene, desired_speed_mps: float) -> FixedScene:
    """The scene with another desired speed of the ego, m/s."""
    return replace(scene, rows=(replace(scene.rows[0], desired_speed_mps=desired_speed_mps), *scene.rows[1:]))


def _agreed(path: Path, name: str, in_file: Any, given: float | None) -> Any:
    """The value of the file or of the caller; an error if they differ."""
    if in_file is not None and given is not None and in_file != given:
        raise UserError(
            f"{path}: {name} is {in_file:g} in the file and {given:g} was asked for; leave one of them out."
        )
    return given if in_file is None else in_file


def _lanes_in(rows: list[SceneVehicle], lane_width_m: float) -> int:
    """Just enough lanes for all vehicles and their target lanes."""
    lanes = [row.lane if row.lane is not None else round((row.y_m or 0.0) / lane_width_m) for row in rows]
    return 1 + max((*lanes, *(row.target_lane or 0 for row in rows), 0))


def _read_csv(path: Path) -> tuple[list[SceneVehicle], dict[str, Any]]:
    with path.open(newline="", encoding="utf-8-sig") as opened:
        lines = [(number, line) for number, line in enumerate(opened, 1) if line.strip() and line.lstrip()[0] != "#"]
    if not lines:
        raise UserError(f"{path}: empty; expected a header with {', '.join(COLUMNS)}, and a line per vehicle.")
    check_count(str(path), len(lines) - 1)
    header, *body = (_cells(line, f"{path}: line {number}") for number, line in lines)
    _check_names(header, f"{path}: line {lines[0][0]}")
    rows = []
    for (number, _), cells in zip(lines[1:], body, strict=True):
        if len(cells) != len(header):
            raise UserError(f"{path}: line {number}: {len(cells)} cells, the header has {len(header)}; fix the line.")
        given = {name: cell for name, cell in zip(header, cells, strict=True) if cell}
        rows.append(_row(given, f"{path}: line {number}", f"line {number}"))
    return rows, {}


def _cells(line: str, where: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line]))]
    except csv.Error as error:
        raise UserError(f"{where}: not a line of CSV ({error}); fix the line.") from error


def _read_json(path: Path) -> tuple[list[SceneVehicle], dict[str, Any]]:
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError:
        raise
    # A ValueError without a place in the file: a whole number of thousands of digits.
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not JSON ({error}); fix the file.") from error
    content = {"vehicles": content} if isinstance(content, list) else content
    if not isinstance(content, dict) or not isinstance(content.get("vehicles"), list):
        raise UserError(f"{path}: expected a list of vehicles, or an object with 'vehicles'; see docs/scenarios.md.")
    check_count(str(path), len(content["vehicles"]))
    return list(_json_rows(path, content["vehicles"])), _json_road(path, content)


def _json_rows(path: Path, vehicles: list[Any]) -> Iterator[SceneVehicle]:
    for number, given in enumerate(vehicles, 1):
        where = f"{path}: vehicles entry {number}"
        if not isinstance(given, dict):
            raise UserError(f"{where}: expected an object with {', '.join(COLUMNS)}.")
        _check_names(list(given), where, need_place=False)
        yield _row({name: value for name, value in given.items() if value is not None}, where, f"entry {number}")


def _json_road(path: Path, content: Mapping[str, Any]) -> dict[str, Any]:
    unknown = set(content) - {"lanes", "lane_width_m", "vehicles"}
    if unknown:
        raise UserError(f"{path}: unknown key {_quoted(min(unknown))}; expected lanes, lane_width_m and vehicles.")
    road: dict[str, Any] = {}
    if content.get("lanes") is not None:
        road["lanes"] = _number("lanes", content["lanes"], f"{path}: lanes", whole=True)
    if content.get("lane_width_m") is not None:
        road["lane_width_m"] = _number("lane_width_m", content["lane_width_m"], f"{path}: lane_width_m", whole=False)
    for name, value in road.items():
        if not 0 < value < float("inf"):
            raise UserError(f"{path}: {name}={value}: expected a finite number above 0.")
    return road


def _check_names(names: list[str], where: str, need_place: bool = True) -> None:
    """Check that column names are known and unique, and that the required ones are present."""
    for name in names:
        if name not in COLUMNS:
            unknown = _quoted(name) if name else "(empty)"
            raise UserError(f"{where}: unknown column {unknown}; expected some of {', '.join(COLUMNS)}.")
        if names.count(name) > 1:
            raise UserError(f"{where}: column {name} is given twice; remove one.")
    if need_place and ("x_m" not in names or not {"lane", "y_m"} & set(names)):
        raise UserError(f"{where}: columns x_m and lane (or y_m) are needed; the header has {', '.join(names)}.")


def _row(given: Mapping[str, Any], where: str, origin: str) -> SceneVehicle:
    """A vehicle from its values in a file."""
    if "x_m" not in given:
        raise UserError(f"{where}: column x_m: no value; give the position along the road in m.")
    values = {name: _value(name, value, f"{where}: column {name}") for name, value in given.items()}
    return SceneVehicle(**values, origin=origin)


def _value(name: str, value: Any, where: str) -> Any:
    if name != "visibility":
        return _number(name, value, where, whole=name in WHOLE_NUMBERS)
    kinds = {kind.name.lower(): kind for kind in Visibility}
    if not isinstance(value, str) or value not in kinds:
        raise UserError(f"{where}: {_quoted(value)}: expected one of {', '.join(kinds)}.")
    return kinds[value]


def _quoted(value: Any) -> str:
    """The value in a message, cut where it is long."""
    text = repr(value)
    return text if len(text) <= _QUOTED else f"{text[:_QUOTED]}..."


def _number(name: str, value: Any, where: str, whole: bool) -> float | int:
    try:
        if isinstance(value, bool):
            raise ValueError
        number = float(value)
        if whole and number != int(number):
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        kind = "a whole number" if whole else "a number"
        raise UserError(f"{where}: {_quoted(value)}: expected {kind}.") from None
    return int(number) if whole else number
