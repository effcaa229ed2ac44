"""Everything that the package reads: a small good file of each kind, and the call that reads it."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from benchmarks.torture import damages, runs
from benchmarks.torture.damages import BYTES, TEXT, Damage
from ganlane.agents import load_agent
from ganlane.config.command_line import check
from ganlane.config.runs import with_resumed
from ganlane.data import (
    SyntheticTraffic,
    read_recordings,
    read_scenes,
    synthetic_scenes,
    write_prepared,
    write_scene_csv,
)
from ganlane.errors import UserError
from ganlane.files import CHECKPOINTS
from ganlane.generator.checkpoint import CACHE_VARIABLE, cached, load_generator
from ganlane.parameters.generator import NgsimParameters
from ganlane.realism.measures import SHIPPED_REFERENCE, Reference
from ganlane.sim.scene_files import read_scene
from ganlane.training.checkpoint import TrainingState
from ganlane.training.logs import CsvLog, read_rows
from ganlane.training.loop import collect
from ganlane.training.phases import identity, make_collector, make_initial_agent, phases_of
from ganlane.view.figures import draw_runs, read_runs

#: The files below the folder of the good ones.
SCENE = "x_m,lane,speed_mps,desired_speed_mps,length_m,visibility\n0,1,20,25,4.5,body\n40,1,18,22,4.5,\n30,0,15,20,12,\n"
FEET = 0.3048


@dataclass(frozen=True)
class Reader:
    """A kind of file.

    Attributes:
        file: its name below the folder that :func:`make_files` fills.
        read: what the package does with it; it gives the content as far as it can be compared.
        ways: to damage it.
        sealed: whether it carries a checksum, so that no change of its content may pass in silence.
        share: how often it is chosen, beside the others.
    """

    file: str
    read: Callable[[Path], Any]
    ways: tuple[Damage, ...]
    sealed: bool = False
    share: int = 6


def make_files(folder: Path) -> None:
    """One good file of each kind; in a process that may not fork afterwards (polars has threads)."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("agent_idm", "generator_paper", "generator_calibrated"):
        shutil.copy(CHECKPOINTS / f"{name}.safetensors", folder)
    shutil.copy(SHIPPED_REFERENCE, folder / "reference.json")
    (folder / "scene.csv").write_text(SCENE)
    rows = [{"x_m": 40.0 * i, "lane": i % 3, "speed_mps": 20.0 - i} for i in range(3)]
    (folder / "scene.json").write_text(
        json.dumps({"lanes": 3, "lane_width_m": 4.0, "vehicles": rows})
    )
    frame = synthetic_scenes(
        SyntheticTraffic(scenes=1, vehicles=6, seconds=4.0, changing_share=0.0), seed=4
    )
    write_scene_csv(frame, folder / "recording.csv")
    write_prepared(frame, folder / "recording.parquet")
    (folder / "ngsim.csv").write_text(_ngsim(frame))
    _highd(folder / "highd")
    os.environ[CACHE_VARIABLE] = str(folder / "cache")
    cached("groups", "key", lambda: {"labels": np.arange(500)})
    run = folder / "run"
    status = runs.train(
        [*runs.TINY, "traffic=idm", "init=none", "total_decisions=192", f"hydra.run.dir={run}"]
    )
    assert status == 0


def _ngsim(frame: pl.DataFrame) -> str:
    """A synthetic recording in NGSIM's columns: feet, front centres, lanes from the left."""
    columns = {
        "Vehicle_ID": pl.col("vehicle"),
        "Frame_ID": pl.col("frame"),
        "Total_Frames": pl.len().over("vehicle"),
        "Global_Time": 1_118_847_000_000 + 100 * pl.col("frame"),
        "Local_X": (8.75 - pl.col("y")) / FEET,
        "Local_Y": (pl.col("x") + 0.5 * pl.col("length")) / FEET,
        "v_length": pl.col("length") / FEET,
        "v_Width": pl.col("width") / FEET,
        "v_Class": pl.lit(2),
        "v_Vel": pl.col("speed") / FEET,
        "Lane_ID": 3 - pl.col("lane"),
    }
    return frame.sort("vehicle", "frame").select(**columns).write_csv()


def _highd(folder: Path) -> None:
    """A synthetic recording in highD's three files: a car each way."""
    folder.mkdir()
    rows = [
        f"{i + 1},{car},{(500 - 1.2 * i) if car == 1 else 1.2 * i},{y},4.5,1.8,{-30 if car == 1 else 30},0,0,0,{lane}"
        for car, y, lane in ((1, 9.1, 2), (2, 25.1, 6))
        for i in range(100)
    ]
    head = "frame,id,x,y,width,height,xVelocity,yVelocity,xAcceleration,yAcceleration,laneId"
    (folder / "01_tracks.csv").write_text("\n".join([head, *rows]) + "\n")
    meta = "id,width,height,initialFrame,finalFrame,numFrames,class,drivingDirection"
    (folder / "01_tracksMeta.csv").write_text(
        f"{meta}\n1,4.5,1.8,1,100,100,Car,1\n2,4.5,1.8,1,100,100,Car,2\n"
    )
    (folder / "01_recordingMeta.csv").write_text(
        "id,frameRate,upperLaneMarkings,lowerLaneMarkings\n1,25,8.00;12.00;16.00,20.00;24.00;28.00\n"
    )


def _agent(path: Path) -> Any:
    policy, metadata = load_agent(path)
    return policy.state_dict(), metadata


def _generator(path: Path) -> Any:
    generator, metadata = load_generator(path)
    return generator.state_dict(), metadata


def _checkpoint(path: Path) -> Any:
    """The run goes on from it, by a step."""
    config = check("train", with_resumed("train", [f"resume={path.parents[1]}"], False)).config
    (phase,) = phases_of(config, path.parents[1])
    config, agent = make_initial_agent(config, phase, path)
    state = TrainingState(make_collector(config, phase), agent, identity(config, phase))
    state.restore(path)
    content = state.state_dict()
    content["counters"].pop("wall_s")
    collect(state)
    return content


def _cache(path: Path) -> Any:
    """What is damaged is computed again."""
    os.environ[CACHE_VARIABLE] = str(path.parent)

    def again() -> dict[str, np.ndarray]:
        raise UserError("computed again")

    return cached("groups", "key", again)


def _reference(path: Path) -> Any:
    reference = Reference.load(path)
    return {**vars(reference), "counts": dict(reference.counts)}


def _overrides(path: Path) -> Any:
    return check("train", with_resumed("train", [f"resume={path.parent}"], False)).config


def _log(path: Path) -> Any:
    """A resumed run goes on with the file."""
    rows = read_rows(path)
    CsvLog(path, list(rows[0]) if rows else ["decisions"], 10**9).close()
    return rows


def _curves(path: Path) -> Any:
    from matplotlib import pyplot

    pyplot.close(draw_runs(read_runs([path.parent])))
    return None


def _recording(kind: str, parameters: NgsimParameters | None = None) -> Callable[[Path], Any]:
    return lambda path: read_recordings(kind, path, parameters)


TABLE = (*BYTES, damages.in_parquet, damages.in_parquet)
READERS = {
    "agent": Reader("agent_idm.safetensors", _agent, (*BYTES, damages.in_safetensors), True),
    "generator": Reader(
        "generator_paper.safetensors", _generator, (*BYTES, damages.in_safetensors), True
    ),
    "calibrated generator": Reader(
        "generator_calibrated.safetensors", _generator, (*BYTES, damages.in_safetensors), True
    ),
    "last.pt": Reader(
        "run/checkpoints/last.pt",
        _checkpoint,
        (*BYTES, damages.in_torch, damages.in_torch),
        True,
        1,
    ),
    "cached windows": Reader("cache/groups_key.npz", _cache, (*BYTES, damages.in_arrays), True),
    "histograms": Reader("reference.json", _reference, (*TEXT, damages.in_json), True),
    "scene CSV": Reader("scene.csv", read_scene, TEXT),
    "scene JSON": Reader("scene.json", read_scene, (*TEXT, damages.in_json, damages.in_json)),
    "recording CSV": Reader("recording.csv", read_scenes, TEXT),
    "recording Parquet": Reader("recording.parquet", read_scenes, TABLE),
    "NGSIM CSV": Reader(
        "ngsim.csv", _recording("ngsim", NgsimParameters(locations=("us-101",))), TEXT
    ),
    "highD tracks": Reader("highd/01_tracks.csv", _recording("highd"), TEXT),
    "highD vehicles": Reader(
        "highd/01_tracksMeta.csv", lambda path: _recording("highd")(_tracks(path)), TEXT, share=2
    ),
    "highD road": Reader(
        "highd/01_recordingMeta.csv", lambda path: _recording("highd")(_tracks(path)), TEXT, share=2
    ),
    "overrides.yaml": Reader("run/overrides.yaml", _overrides, TEXT, share=1),
    "config.yaml": Reader("run/config.yaml", _overrides, TEXT, share=1),
    "metrics.csv, resumed": Reader("run/metrics.csv", _log, TEXT),
    "evaluation.csv, resumed": Reader("run/evaluation.csv", _log, TEXT),
    "metrics.csv, drawn": Reader("run/metrics.csv", _curves, TEXT, share=1),
}


def _tracks(path: Path) -> Path:
    return path.with_name("01_tracks.csv")
