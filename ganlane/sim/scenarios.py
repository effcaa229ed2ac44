"""Hand-made scenes by name and from files; m, m/s, and the ego comes first.

The test scenarios cut-in, stalled car, stop-and-go wave and blocked lane are functions of a few
numbers that return the rows of a :class:`~ganlane.sim.scenes.FixedScene`. A file is CSV (one line
per vehicle) or JSON. CSV has a header and these columns, of which ``x_m`` and ``lane`` (or ``y_m``)
are required; lines that start with ``#`` are skipped, and an empty cell means the default::

    x_m, lane, y_m, speed_mps, desired_speed_mps, length_m, width_m, target_lane, visibility

JSON is a list of objects with the same names, or
``{"lanes": 3, "lane_width_m": 4.0, "vehicles": [...]}``.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import fields, replace
from itertools import accumulate
from pathlib import Path
from typing import Any

from ganlane.errors import UserError
from ganlane.settings.driving import IdmParameters, Visibility
from ganlane.sim.idm import TABLE_V
from ganlane.sim.scenes import FixedScene, SceneVehicle, check_count
from ganlane.sim.state import Road

LENGTH_M = 4.5
#: Desired speed of a broken-down vehicle; IDM requires more than 0.
STALLED_MPS = 0.001
#: A broken-down car is this far right of its lane's centre. Off-centre vehicles start no lane
#: change, so MOBIL's politeness does not make it change lanes to let others pass.
ASKEW_M = 0.6


def stalled(x_m: float, lane: int, lane_width_m: float = 4.0) -> SceneVehicle:
    """A vehicle that has broken down in ``lane``."""
    return SceneVehicle(x_m, y_m=lane * lane_width_m - ASKEW_M, desired_speed_mps=STALLED_MPS)


def cut_in(
    gap_m: float = 20.0,
    speed_mps: float = 20.0,
    cutter_speed_mps: float = 17.0,
    lanes: int = 3,
    desired_speed_mps: float = 25.0,
) -> tuple[SceneVehicle, ...]:
    """A slower vehicle one lane to the left, ``gap_m`` ahead of the ego's bumper, moves into its
    lane at once.

    There are a leader 80 m ahead of the ego, a follower 35 m behind it, a vehicle behind the one
    that cuts in, and (on three lanes) one on the ego's right, so that braking is the obvious
    reaction.
    """
    _at_least(lanes, 2, "cut_in")
    own = lanes - 2
    right = (SceneVehicle(-8.0, own - 1, speed_mps, speed_mps),) if own > 0 else ()
    return (
        SceneVehicle(0.0, own, speed_mps, desired_speed_mps),
        SceneVehicle(
            gap_m + LENGTH_M, own + 1, cutter_speed_mps, cutter_speed_mps, target_lane=own
        ),
        SceneVehicle(80.0, own, speed_mps, 22.0),
        SceneVehicle(-35.0, own, speed_mps, 22.0),
        SceneVehicle(-40.0, own + 1, speed_mps, 24.0),
        *right,
    )


def stalled_car(
    distance_m: float = 200.0,
    speed_mps: float = 20.0,
    spacing_m: float = 120.0,
    lanes: int = 3,
    desired_speed_mps: float = 25.0,
    lane_width_m: float = 4.0,
) -> tuple[SceneVehicle, ...]:
    """A broken-down vehicle ``distance_m`` ahead in the ego's lane, the rightmost.

    A vehicle follows the ego, and five vehicles ``spacing_m`` apart pass in the next lane, if there
    is one.
    """
    beside = () if lanes == 1 else _column(1, 5, 0.5 * spacing_m, spacing_m, speed_mps, 22.0)
    return (
        SceneVehicle(0.0, 0, speed_mps, desired_speed_mps),
        stalled(distance_m, 0, lane_width_m),
        SceneVehicle(-50.0, 0, speed_mps, 22.0),
        *beside,
    )


def blocked_lane(
    distance_m: float = 250.0,
    standing: int = 3,
    speed_mps: float = 15.0,
    spacing_m: float = 60.0,
    lanes: int = 2,
    desired_speed_mps: float = 25.0,
    lane_width_m: float = 4.0,
) -> tuple[SceneVehicle, ...]:
    """The rightmost lane is closed by ``standing`` vehicles in a row, from ``distance_m`` on; the
    others are open.

    In each open lane drive six vehicles, ``spacing_m`` apart: the ego has to find a gap.
    """
    _at_least(lanes, 2, "blocked_lane")
    closed = (stalled(distance_m + (LENGTH_M + 1.5) * k, 0, lane_width_m) for k in range(standing))
    return (
        SceneVehicle(0.0, 0, speed_mps, desired_speed_mps),
        *closed,
        SceneVehicle(-50.0, 0, speed_mps, 20.0),
        *(
            car
            for lane in range(1, lanes)
            for car in _column(lane, 6, 1.3 * spacing_m, spacing_m, speed_mps, 20.0)
        ),
    )


def _column(
    lane: int,
    vehicles: int,
    first_m: float,
    spacing_m: float,
    speed_mps: float,
    desired_speed_mps: float,
) -> tuple[SceneVehicle, ...]:
    """Vehicles in one lane, from ``first_m`` backwards."""
    return tuple(
        SceneVehicle(first_m - spacing_m * k, lane, speed_mps, desired_speed_mps)
        for k in range(vehicles)
    )


def stop_and_go(
    waves: int = 2,
    per_wave: int = 5,
    speed_mps: float = 10.0,
    lanes: int = 2,
    desired_speed_mps: float = 25.0,
    idm: IdmParameters = TABLE_V,
) -> tuple[SceneVehicle, ...]:
    """Columns in every lane, of alternately ``per_wave`` stopped and ``per_wave`` moving vehicles.

    From the head: two moving vehicles, then ``waves`` times a stopped queue at IDM's minimum gap
    and a group that approaches it at ``speed_mps`` in steady following. The ego is the last but one
    of the rightmost lane. The desired speed of the others is 15 m/s.
    """
    steady = LENGTH_M + 1.1 * (idm.min_gap_m + idm.headway_s * speed_mps)
    queue = LENGTH_M + idm.min_gap_m
    approach = 5.0 * speed_mps
    speeds, spacings = [speed_mps] * 2, [0.0, steady]
    for _ in range(waves):
        speeds += [0.0] * per_wave + [speed_mps] * per_wave
        spacings += [steady] + [queue] * (per_wave - 1) + [approach] + [steady] * (per_wave - 1)
    column = [(-x, speed) for x, speed in zip(accumulate(spacings), speeds, strict=True)]
    ego_x, ego_speed = column[-2]
    others = [
        SceneVehicle(x - 7.0 * lane, lane, speed, 15.0)
        for lane in range(lanes)
        for k, (x, speed) in enumerate(column)
        if lane > 0 or k != len(column) - 2
    ]
    return (SceneVehicle(ego_x, 0, ego_speed, desired_speed_mps), *others)


def _at_least(lanes: int, needed: int, name: str) -> None:
    if lanes < needed:
        raise UserError(
            f"env.lanes={lanes}: env={name} needs {needed} lanes or more; give env.lanes={needed}."
        )


# Files

#: Columns of a scene file.
COLUMNS = tuple(field.name for field in fields(SceneVehicle) if field.name != "origin")
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
    if not path.is_file():
        raise UserError(f"{path}: no such file; give a scene as .csv or .json.")
    readers = {".csv": _read_csv, ".json": _read_json}
    if path.suffix.lower() not in readers:
        raise UserError(f"{path}: expected a scene as .csv or .json; rename or convert the file.")
    if path.stat().st_size > _MOST_BYTES:
        raise UserError(
            f"{path}: more than {_MOST_BYTES} bytes, which no scene has; give a smaller file."
        )
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise UserError(
            f"{path}: not a text file in UTF-8 ({error.reason}); save the scene as one."
        ) from error
    rows, road = readers[path.suffix.lower()](path, text)
    width = _agreed(path, "lane_width_m", road.get("lane_width_m"), lane_width_m) or LANE_WIDTH_M
    count = _agreed(path, "lanes", road.get("lanes"), lanes) or _lanes_in(rows, width)
    return FixedScene(tuple(rows), Road(int(count), float(width)), name=str(path))


def with_ego_speed(scene: FixedScene, desired_speed_mps: float) -> FixedScene:
    """The scene with another desired speed of the ego, m/s."""
    return replace(
        scene, rows=(replace(scene.rows[0], desired_speed_mps=desired_speed_mps), *scene.rows[1:])
    )


def _agreed(path: Path, name: str, in_file: Any, given: float | None) -> Any:
    """The value of the file or of the caller; an error if they differ."""
    if in_file is not None and given is not None and in_file != given:
        raise UserError(
            f"{path}: {name} is {in_file:g} in the file and {given:g} was asked for; leave one of them out."
        )
    return given if in_file is None else in_file


def _lanes_in(rows: list[SceneVehicle], lane_width_m: float) -> int:
    """Just enough lanes for all vehicles and their target lanes."""
    lanes = [
        row.lane if row.lane is not None else round((row.y_m or 0.0) / lane_width_m) for row in rows
    ]
    return 1 + max((*lanes, *(row.target_lane or 0 for row in rows), 0))


def _read_csv(path: Path, text: str) -> tuple[list[SceneVehicle], dict[str, Any]]:
    lines = [(number, line) for number, line in enumerate(text.split("\n"), 1) if line.strip()]
    lines = [(number, line) for number, line in lines if line.lstrip()[0] != "#"]
    if not lines:
        raise UserError(
            f"{path}: empty; expected a header with {', '.join(COLUMNS)}, and a line per vehicle."
        )
    check_count(str(path), len(lines) - 1)
    header, *body = (_cells(line, f"{path}: line {number}") for number, line in lines)
    _check_names(header, f"{path}: line {lines[0][0]}")
    rows = []
    for (number, _), cells in zip(lines[1:], body, strict=True):
        if len(cells) != len(header):
            raise UserError(
                f"{path}: line {number}: {len(cells)} cells, the header has {len(header)}; fix the line."
            )
        given = {name: cell for name, cell in zip(header, cells, strict=True) if cell}
        rows.append(_row(given, f"{path}: line {number}", f"line {number}"))
    return rows, {}


def _cells(line: str, where: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line]))]
    except csv.Error as error:
        raise UserError(f"{where}: not a line of CSV ({error}); fix the line.") from error


def _read_json(path: Path, text: str) -> tuple[list[SceneVehicle], dict[str, Any]]:
    try:
        content = json.loads(text)
    # A ValueError without a place in the file: a whole number of thousands of digits.
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not JSON ({error}); fix the file.") from error
    content = {"vehicles": content} if isinstance(content, list) else content
    if not isinstance(content, dict) or not isinstance(content.get("vehicles"), list):
        raise UserError(
            f"{path}: expected a list of vehicles, or an object with 'vehicles'; see docs/scenarios.md."
        )
    vehicles = content.pop("vehicles")
    check_count(str(path), len(vehicles))
    rows = []
    for number, given in enumerate(vehicles, 1):
        where = f"{path}: vehicles entry {number}"
        if not isinstance(given, dict):
            raise UserError(f"{where}: expected an object with {', '.join(COLUMNS)}.")
        _check_names(list(given), where, need_place=False)
        values = {name: value for name, value in given.items() if value is not None}
        rows.append(_row(values, where, f"entry {number}"))
    return rows, _json_road(path, content)


def _json_road(path: Path, content: Mapping[str, Any]) -> dict[str, Any]:
    unknown = set(content) - {"lanes", "lane_width_m"}
    if unknown:
        raise UserError(
            f"{path}: unknown key {_quoted(min(unknown))}; expected lanes, lane_width_m and vehicles."
        )
    given = {
        name: content[name] for name in ("lanes", "lane_width_m") if content.get(name) is not None
    }
    road = {name: _value(name, value, f"{path}: {name}") for name, value in given.items()}
    for name, value in road.items():
        if not 0 < value < float("inf"):
            raise UserError(f"{path}: {name}={value}: expected a finite number above 0.")
    return road


def _check_names(names: list[str], where: str, need_place: bool = True) -> None:
    """Check that column names are known and unique, and that the required ones are present."""
    for name in names:
        if name not in COLUMNS:
            unknown = _quoted(name) if name else "(empty)"
            raise UserError(
                f"{where}: unknown column {unknown}; expected some of {', '.join(COLUMNS)}."
            )
        if names.count(name) > 1:
            raise UserError(f"{where}: column {name} is given twice; remove one.")
    if need_place and ("x_m" not in names or not {"lane", "y_m"} & set(names)):
        raise UserError(
            f"{where}: columns x_m and lane (or y_m) are needed; the header has {', '.join(names)}."
        )


def _row(given: Mapping[str, Any], where: str, origin: str) -> SceneVehicle:
    """A vehicle from its values in a file."""
    if "x_m" not in given:
        raise UserError(f"{where}: column x_m: no value; give the position along the road in m.")
    values = {name: _value(name, value, f"{where}: column {name}") for name, value in given.items()}
    return SceneVehicle(**values, origin=origin)


def _value(name: str, value: Any, where: str) -> Any:
    """A number, or a :class:`Visibility`, from what stands in a file."""
    if name == "visibility":
        kinds = {kind.name.lower(): kind for kind in Visibility}
        if not isinstance(value, str) or value not in kinds:
            raise UserError(f"{where}: {_quoted(value)}: expected one of {', '.join(kinds)}.")
        return kinds[value]
    whole = name in WHOLE_NUMBERS
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


def _quoted(value: Any) -> str:
    """The value in a message, cut where it is long."""
    text = repr(value)
    return text if len(text) <= _QUOTED else f"{text[:_QUOTED]}..."
