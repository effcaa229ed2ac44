"""Recordings in the schema, written out as NGSIM and highD publish theirs.

The readers' way, backwards.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
from reference.synthetic import synthetic_scenes

from ganlane.data.dense import Recording, recordings_of

FOOT_M = 0.3048
LANE_M = 3.5
#: 15 June 2005, 14:50 UTC, in milliseconds.
START_MS = 1_118_847_000_000


def traffic(**more) -> pl.DataFrame:
    """Six seconds of nine vehicles on three lanes in two scenes."""
    return synthetic_scenes(vehicles=9, seconds=6.0, changing_share=0.0, **more, seed=4)


def feet(metres: pl.Expr) -> pl.Expr:
    return (metres / FOOT_M).round(6)


def ngsim_rows(scene: pl.DataFrame, start_ms: int = START_MS) -> pl.DataFrame:
    """One scene of three lanes in NGSIM's 18 columns.

    Feet, front centres, lanes and positions from the left.
    """
    return scene.sort("vehicle", "frame").select(
        Vehicle_ID="vehicle",
        Frame_ID="frame",
        Total_Frames=pl.len().over("vehicle"),
        Global_Time=start_ms + 100 * pl.col("frame"),
        Local_X=feet(2.5 * LANE_M - pl.col("y")),
        Local_Y=feet(pl.col("x") + 0.5 * pl.col("length")),
        Global_X=(6_451_137.641 + pl.col("y")).round(3),
        Global_Y=(1_873_344.962 + pl.col("x")).round(3),
        v_length=feet(pl.col("length")),
        v_Width=feet(pl.col("width")),
        v_Class=pl.lit(2),
        v_Vel=feet(pl.col("speed")),
        v_Acc=pl.lit(0.0),
        Lane_ID=3 - pl.col("lane"),
        **dict.fromkeys(("Preceding", "Following", "Space_Headway", "Time_Headway"), pl.lit(0)),
    )


def raw_text(rows: pl.DataFrame) -> str:
    """NGSIM's text files: no header, columns parted by blanks and tabs, Windows line ends."""
    return "".join(" " + "  ".join(map(str, row)) + " \t\r\n" for row in rows.iter_rows())


def portal_csv(rows: pl.DataFrame, location: str = "us-101") -> str:
    """The portal's CSV: lower-case names, a location, numbers with commas between thousands."""

    def field(value) -> str:
        if not isinstance(value, str) and abs(value) >= 1000:
            whole, dot, rest = str(value).partition(".")
            return f'"{int(whole):,}{dot}{rest}"'
        return str(value)

    named = rows.rename(str.lower).with_columns(location=pl.lit(location))
    return "".join(",".join(map(field, row)) + "\n" for row in [named.columns, *named.iter_rows()])


def write_highd(folder: Path, name: str = "01", seconds: float = 8.0) -> None:
    """One recording with two lanes each way and a car in each.

    Upper lanes between 8, 12 and 16 m, lower ones between 20, 24 and 28 m. Car 1 drives to the left
    in the upper outer lane, car 2 to the left in the inner one and then out; car 3 to the right in
    the lower outer lane.
    """
    folder.mkdir(parents=True, exist_ok=True)
    frame = np.arange(1, int(25 * seconds) + 1)
    tracks = []
    for vehicle, (centre_x, speed, centre_y, lane) in HIGHD_CARS.items():
        track = {
            "frame": frame,
            "id": vehicle,
            "x": centre_x + speed * (frame - 1) / 25.0 - 2.5,
            "y": centre_y - 1.0,
            "width": 5.0,
            "height": 2.0,
            "xVelocity": speed,
            "laneId": lane,
        }
        tracks.append(pl.DataFrame(track))
    pl.concat(tracks).write_csv(folder / f"{name}_tracks.csv")
    cars = {"id": list(HIGHD_CARS), "drivingDirection": [1, 1, 2, 2]}
    pl.DataFrame(cars).write_csv(folder / f"{name}_tracksMeta.csv")
    recording = {
        "id": 1,
        "frameRate": 25,
        "upperLaneMarkings": "8.00;12.00;16.00",
        "lowerLaneMarkings": "20;24;28",
    }
    pl.DataFrame(recording).write_csv(folder / f"{name}_recordingMeta.csv")


def damage_field(path: Path, column: str, row: int, value: str) -> None:
    """Change one field of a CSV file; ``row`` counts from 0 below the header."""
    # As text, so that all other fields stay as they are.
    table = pl.read_csv(path, infer_schema=False).with_row_index()
    field = pl.when(pl.col("index") == row).then(pl.lit(value)).otherwise(column).alias(column)
    table.with_columns(field).drop("index").write_csv(path)


def recorded_cars(**size) -> list[Recording]:
    """Synthetic scenes as recordings."""
    return recordings_of(synthetic_scenes(**size))


def made_by_hand(x, y=None, speed=0.0, lanes=3, name="scene", **changed) -> Recording:
    """Cars of 4 m at positions ``x`` [T, V] on lanes of 3.5 m, all of them present and driven."""
    x = np.asarray(x, dtype=np.float64)
    size = np.ones(x.shape[1])
    y, speed = (
        np.broadcast_to(number, x.shape).astype(np.float64)
        for number in (0.0 if y is None else y, speed)
    )
    fields = {
        "y": y,
        "speed": speed,
        "lane": np.rint(y / 3.5).astype(np.int64),
        "present": np.ones(x.shape, bool),
        "driven": size > 0,
        **changed,
    }
    return Recording(name, name, lanes, 3.5, x, length=4.0 * size, width=2.0 * size, **fields)


def following_file(path: Path) -> None:
    """An I-80 file of one follower behind its leader: 20 s at 7 m/s, a gap of 10 m."""
    frame = np.arange(200)
    rows = {
        "period": "0400pm",
        "follower": 2,
        "leader": 1,
        "frame": frame,
        "x_follower": 0.7 * frame,
        "x_leader": 0.7 * frame + 16.0,
        "leader_length": 6.0,
    }
    pl.DataFrame(rows).write_csv(path)


#: Vehicle: first centre along the picture, speed, centre across the picture (downwards), highD's
#: lane number.
HIGHD_CARS = {
    1: (400.0, -30.0, 10.0, 2),
    2: (380.0, -35.0, 14.5, 3),
    3: (10.0, 25.0, 26.0, 6),
    4: (60.0, 28.0, 22.0, 5),
}
