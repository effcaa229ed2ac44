"""What a measuring command leaves in its run folder: ``results.json`` and ``episodes.parquet``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import torch

from ganlane.evaluation.provenance import code_version, machine
from ganlane.files import atomic_path, write_json


def plain(value: Any) -> Any:
    """``value`` as JSON can hold it: plain numbers, strings, lists and dictionaries; NaN and infinity as None."""
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, range)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic, torch.Tensor)):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, (bool, int, str)) else str(value)


def results_record(numbers: Mapping[str, Any], config: Mapping[str, Any], seeds: Mapping[str, Any]) -> dict[str, Any]:
    """The content of ``results.json``: the numbers, and all it takes to know where they come from.

    Args:
        numbers: the command's own results, for instance ``{"rows": evaluation_rows(...)}``.
        config: the whole configuration, plain or dataclasses.
        seeds: the seeds and episode numbers behind the numbers.
    """
    return plain(
        {
            **numbers,
            "seeds": seeds,
            "config": config,
            "code": code_version(),
            "machine": machine(),
            "written": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        }
    )


def write_results(
    folder: str | Path, numbers: Mapping[str, Any], config: Mapping[str, Any], seeds: Mapping[str, Any]
) -> Path:
    """Write ``results.json`` into ``folder`` atomically and return its path (see :func:`results_record`)."""
    path = Path(folder) / "results.json"
    write_json(path, results_record(numbers, config, seeds))
    return path


def write_episodes(folder: str | Path, episodes: pl.DataFrame) -> Path:
    """Write one row per episode as ``episodes.parquet`` into ``folder`` atomically and return its path."""
    path = Path(folder) / "episodes.parquet"
    with atomic_path(path) as part:
        episodes.write_parquet(part)
    return path
