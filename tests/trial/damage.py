"""Reads thousands of damaged files: each must be refused in one sentence, or read for what it says.

A traceback is anything but a ``UserError`` (or the file system's ``OSError``, of which a command
makes a sentence). A file that carries a checksum must not be read with another content in silence:
refused, or told of.
"""

from __future__ import annotations

import io
import itertools
import os
import pickle
import random
import shutil
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
import torch
from matplotlib import pyplot
from reference.recordings import ngsim_rows, portal_csv, traffic, write_highd
from reference.scene_csv import write_scene_csv

from ganlane.agents import read_agent
from ganlane.data import read_recordings, read_scenes, write_prepared
from ganlane.errors import UserError
from ganlane.files import CHECKPOINTS
from ganlane.generator.checkpoint import load_generator
from ganlane.realism.measures import SHIPPED_REFERENCE, Reference
from ganlane.settings.generator import NgsimParameters
from ganlane.sim.scene_files import read_scene
from ganlane.training.logs import read_rows
from ganlane.view.curves import draw_runs, read_runs

from . import damages
from .damages import BYTES, TEXT, Damage
from .kill import TINY, train
from .tally import Tally, forked

#: Seconds and GiB that reading one small file may take.
AT_MOST_S, MEMORY_GIB = 60.0, 12.0
#: Inputs handed to a child at a time.
BATCH = 2000
SCENE = (
    "x_m,lane,speed_mps,desired_speed_mps,length_m\n0,1,20,25,4.5\n40,1,18,22,4.5\n30,0,15,20,12\n"
)


class Reader(NamedTuple):
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
    """One good file of each kind."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("agent_idm", "generator_paper"):
        shutil.copy(CHECKPOINTS / f"{name}.safetensors", folder)
    shutil.copy(SHIPPED_REFERENCE, folder / "reference.json")
    (folder / "scene.csv").write_text(SCENE)
    (folder / "scene.json").write_text(
        '{"lanes": 3, "vehicles": [{"x_m": 0.0, "lane": 0, "speed_mps": 20.0},'
        ' {"x_m": 40.0, "lane": 1}, {"x_m": 80.0, "lane": 2}]}'
    )
    frame = traffic().filter(pl.col("scene") == "synthetic-0")
    write_scene_csv(frame, folder / "recording.csv")
    write_prepared(frame, folder / "recording.parquet")
    (folder / "ngsim.csv").write_text(portal_csv(ngsim_rows(frame)))
    write_highd(folder / "highd")
    short = ["traffic=idm", "init=none", "total_decisions=192", f"hydra.run.dir={folder / 'run'}"]
    with redirect_stdout(io.StringIO()):
        assert train([*TINY, *short]) == 0


def _generator(path: Path) -> Any:
    generator, metadata = load_generator(path)
    return dict(generator.state_dict()), metadata


def _resumed(path: Path) -> Any:
    """The run goes on, by one decision of each environment."""
    run = path.parent if path.parent.name == "run" else path.parents[1]
    said = io.StringIO()
    with redirect_stderr(said):
        status = train([f"resume={run}", "total_decisions=200"])
    if status == 2:
        raise UserError(said.getvalue())
    assert status == 0, said.getvalue()
    print(said.getvalue())  # what was told of
    return read_agent(run / "agent.safetensors")[0]


def _reference(path: Path) -> Any:
    return repr(vars(Reference.load(path)))


def _curves(path: Path) -> None:
    pyplot.close(draw_runs(read_runs([path.parent])))


def _ngsim_rows(path: Path) -> Any:
    return read_recordings("ngsim", path, NgsimParameters(locations=("us-101",)))


def _highd_rows(path: Path) -> Any:
    return read_recordings("highd", path.with_name("01_tracks.csv"), None)


WEIGHTS = (*BYTES, damages.in_safetensors)
STATE = (*BYTES, damages.in_torch, damages.in_torch)
TABLE = (*BYTES, damages.in_parquet, damages.in_parquet)
JSON = (*TEXT, damages.in_json, damages.in_json)
READERS = {
    "agent": Reader("agent_idm.safetensors", read_agent, WEIGHTS, True),
    "generator": Reader("generator_paper.safetensors", _generator, WEIGHTS, True),
    "last.pt": Reader("run/checkpoints/last.pt", _resumed, STATE, True, 1),
    "config.yaml": Reader("run/config.yaml", _resumed, TEXT, share=1),
    "metrics.csv, resumed": Reader("run/metrics.csv", read_rows, TEXT),
    "metrics.csv, drawn": Reader("run/metrics.csv", _curves, TEXT, share=1),
    "histograms": Reader("reference.json", _reference, JSON, True),
    "scene CSV": Reader("scene.csv", read_scene, TEXT),
    "scene JSON": Reader("scene.json", read_scene, JSON),
    "recording CSV": Reader("recording.csv", read_scenes, TEXT),
    "recording Parquet": Reader("recording.parquet", read_scenes, TABLE),
    "NGSIM CSV": Reader("ngsim.csv", _ngsim_rows, TEXT),
    "highD tracks": Reader("highd/01_tracks.csv", _highd_rows, TEXT),
    "highD vehicles": Reader("highd/01_tracksMeta.csv", _highd_rows, TEXT, share=2),
    "highD road": Reader("highd/01_recordingMeta.csv", _highd_rows, TEXT, share=2),
}


def damage(tally: Tally, seed: int, end: float, scratch: Path) -> None:
    """Read damaged files until the monotonic clock is at ``end``."""
    trial = Trial(good_files(scratch), scratch / "damaged")
    rng = random.Random(seed)
    names = [name for name, reader in READERS.items() for _ in range(reader.share)]
    for first in itertools.count(seed * 10**7, BATCH):
        items = [(rng.choice(names), number) for number in range(first, first + BATCH)]
        for (name, number), result in forked(trial, items, AT_MOST_S, MEMORY_GIB):
            kind = result.split(maxsplit=1)[0].rstrip(":")
            tally.what["damaged files"] += 1
            tally.what[kind.lower()] += 1
            if kind in ("LOST", "TRACEBACK", "ACCEPTED"):
                tally.fail(f"{name}, input {number} (damage --input '{name}:{number}'): {result}")
            if time.monotonic() > end:
                return


def good_files(scratch: Path) -> Path:
    """The folder with a good file of each kind, made in a child: polars has threads, which no fork
    survives.
    """
    folder = scratch / "good"
    for _, result in forked(make_files, [folder], 600.0, MEMORY_GIB):
        if result is not None:
            raise RuntimeError(f"the good files could not be made: {result}")
    return folder


class Trial:
    """Damages one file and reads it; the result in words that begin with one in capitals."""

    def __init__(self, good: Path, work: Path) -> None:
        self.good, self.work = good, work
        self.contents: dict[str, bytes] = {}

    def __call__(self, item: tuple[str, int]) -> str:
        """What came of the input with this reader and number."""
        name, number = item
        reader, rng = READERS[name], random.Random(number)
        os.chdir(self.good)
        if reader.sealed and name not in self.contents:
            good = self._copy(reader.file, "good")
            self.contents[name] = bits(quietly(reader, good, io.StringIO()))
        path = self._copy(reader.file, str(number))  # some notes are made once for each path
        way = rng.choice(reader.ways)
        path.write_bytes(way(rng, path.read_bytes()))
        said = io.StringIO()
        try:
            content = quietly(reader, path, said)
            unseen = reader.sealed and bits(content) != self.contents[name]
            result = "READ"
            if unseen:
                result = f"ACCEPTED after {way.__name__}, in silence"
                if said.getvalue().strip():
                    result = f"TOLD {said.getvalue()}"
        except UserError as error:
            result = f"REFUSED {error}"
        except BaseException as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            told = f"{type(error).__name__}: {error} ({place})"
            result = f"TRACEBACK after {way.__name__}: {told}"
            if isinstance(error, OSError) and error.errno is not None:
                result = f"REFUSED {error}"
        if Path("executed").exists():
            return "TRACEBACK the code of a bomb ran"
        return result[:400]

    def _copy(self, file: str, folder: str) -> Path:
        """The file among its neighbours, in a folder of its own."""
        shutil.rmtree(self.work, ignore_errors=True)
        path = self.work / folder / file
        top = file.partition("/")[0]
        if top == file:
            path.parent.mkdir(parents=True)
            shutil.copy(self.good / file, path)
        else:
            shutil.copytree(self.good / top, self.work / folder / top)
        return path


def quietly(reader: Reader, path: Path, said: io.StringIO) -> Any:
    """The content of a file; what is printed goes to ``said``."""
    with redirect_stdout(said), redirect_stderr(said), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return reader.read(path)


def bits(content: Any) -> bytes:
    """Contents with the same bits are the same; tensors count by their values."""
    if isinstance(content, dict):
        # safetensors gives its tensors in an order of its own.
        return b"".join(str(key).encode() + bits(content[key]) for key in sorted(content))
    if isinstance(content, list | tuple):
        return b"".join(map(bits, content))
    if isinstance(content, torch.Tensor | np.ndarray):
        array = np.asarray(content)
        return f"{array.dtype} {array.shape}".encode() + array.tobytes()
    return pickle.dumps(content)
