"""Reads thousands of damaged files: each must be refused in one sentence, or read for what it says.

A traceback is anything but a ``UserError`` (or the file system's ``OSError``, of which a command
makes a sentence). A file that carries a checksum must not be read with another content in silence:
refused, or told of.
"""

from __future__ import annotations

import contextlib
import io
import os
import pickle
import random
import shutil
import time
import traceback
import warnings
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.torture.readers import READERS, make_files
from benchmarks.torture.tally import Tally, forked
from ganlane.config.command_line import CONFIG_ERRORS
from ganlane.errors import UserError

#: Seconds and GiB that reading one small file may take.
AT_MOST_S, MEMORY_GIB = 20.0, 12.0
#: Inputs handed to a child at a time.
BATCH = 2000


def damage(tally: Tally, count: int, seed: int, minutes: float, scratch: Path) -> None:
    """Read ``count`` damaged files, or as many as the minutes allow."""
    good = good_files(scratch)
    end, rng = time.monotonic() + 60.0 * minutes, random.Random(seed)
    names = [name for name, reader in READERS.items() for _ in range(reader.share)]
    trial = Trial(good, scratch / "damaged")
    for first in range(0, count, BATCH):
        items = [
            (rng.choice(names), seed * 10**7 + first + i) for i in range(min(BATCH, count - first))
        ]
        for (name, number), result in forked(trial, items, AT_MOST_S, MEMORY_GIB):
            tally.what["damaged files"] += 1
            if result.startswith(("LOST", "TRACEBACK", "ACCEPTED")):
                tally.fail(f"{name}, input {number} (damage --input '{name}:{number}'): {result}")
            kind = result.split(maxsplit=1)[0].lower().rstrip(":")
            tally.what[kind] += 1
            tally.detail[f"{kind}: {name}"] += 1
            if time.monotonic() > end:
                return


def good_files(scratch: Path) -> Path:
    """The folder with a good file of each kind, made in a child.

    Polars has threads, which no fork survives.
    """
    folder = scratch / "good"
    for _, result in forked(make_files, [folder], 600.0, MEMORY_GIB):
        if result is not None:
            raise RuntimeError(f"the good files could not be made: {result}")
    return folder


class Trial:
    """Damages one file and reads it; the result in words that begin with one in capitals."""

    def __init__(self, good: Path, work: Path) -> None:
        self.good, self.top, self.work = good, work, work
        self.contents: dict[str, Any] = {}

    def __call__(self, item: tuple[str, int]) -> str:
        """What came of the input with this reader and number."""
        name, number = item
        reader, rng = READERS[name], random.Random(number)
        os.chdir(self.good)
        self.work = self.top / str(number)  # some notes are made once for each path
        whole = (self.good / reader.file).read_bytes()
        if reader.sealed and name not in self.contents:
            self.contents[name] = reader.read(self._copy(reader.file))
        path = self._copy(reader.file)
        way = rng.choice(reader.ways)
        broken = way(rng, whole)
        path.write_bytes(broken)
        said = io.StringIO()
        try:
            with (
                contextlib.redirect_stdout(said),
                contextlib.redirect_stderr(said),
                warnings.catch_warnings(),
            ):
                warnings.simplefilter("ignore")
                content = reader.read(path)
        except (UserError, *CONFIG_ERRORS) as error:
            text = str(error)
            return (
                "TRACEBACK the code of a bomb ran"
                if "EXECUTED" in said.getvalue()
                else f"REFUSED {text[:200]}"
            )
        except OSError as error:
            if error.errno is not None:
                return f"REFUSED {error}"[:200]
            return f"TRACEBACK after {way.__name__}: {traceback_of(error)}"
        except BaseException as error:
            return f"TRACEBACK after {way.__name__}: {traceback_of(error)}"
        if "EXECUTED" in said.getvalue():
            return "TRACEBACK the code of a bomb ran"
        if not reader.sealed or same(content, self.contents[name]):
            return "READ"
        return (
            f"TOLD {said.getvalue()}"[:200]
            if said.getvalue()
            else f"ACCEPTED after {way.__name__}, in silence"
        )

    def _copy(self, file: str) -> Path:
        """The file among its neighbours, in a folder of its own."""
        shutil.rmtree(self.top, ignore_errors=True)
        path = self.work / file
        self.work.mkdir(parents=True)
        if "/" in file:
            top = file.partition("/")[0]
            shutil.copytree(self.good / top, self.work / top)
        else:
            shutil.copy(self.good / file, path)
        return path


def traceback_of(error: BaseException) -> str:
    """Where an error came from, in a line."""
    place = traceback.extract_tb(error.__traceback__)
    ours = next((frame for frame in reversed(place) if "/ganlane/" in frame.filename), place[-1])
    where = f"{Path(ours.filename).name}:{ours.lineno}"
    return f"{type(error).__name__} at {where}: {str(error)[:200]!r}"


def same(one: Any, other: Any) -> bool:
    """Whether two contents are the same bit for bit."""
    if isinstance(one, dict):
        return (
            isinstance(other, dict)
            and one.keys() == other.keys()
            and all(same(one[k], other[k]) for k in one)
        )
    if isinstance(one, list | tuple):
        return type(one) is type(other) and len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, torch.Tensor | np.ndarray):
        a, b = np.asarray(one), np.asarray(other)
        return (a.dtype, a.shape) == (b.dtype, b.shape) and a.tobytes() == b.tobytes()
    if is_dataclass(one) and not isinstance(one, type):
        return same(asdict(one), asdict(other))
    try:
        return bool(pickle.dumps(one) == pickle.dumps(other) or one == other)
    except Exception:
        return bool(one == other)
