"""``realism`` and ``bench``: how good and how fast, as the commands measure it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ganlane.api.folders import Run, results_of, run_in
from ganlane.api.options import Option, command_config
from ganlane.config.bench import BenchConfig
from ganlane.config.realism import RealismConfig
from ganlane.errors import UserError


def realism(
    traffic: Option = "gan_calibrated",
    against: Sequence[str] = ("idm_mobil",),
    *,
    data: Option = "scenes",
    quick: bool = False,
    env: Option = "highway",
    folder: str | Path | None = None,
    **overrides: Any,
) -> Run:
    """The realism card of a traffic: how close it comes to recorded driving.

    ::

        run = realism("gan_calibrated", ["idm_mobil"], data={"path": "recordings.csv"}, vehicle_km=100)
        run.results["quantities"]["speed"]["distance"]

    On the command line::

        ganlane realism traffic=gan_calibrated 'against=[idm_mobil]' data.path=recordings.csv vehicle_km=100

    Args:
        traffic: as in :func:`ganlane.api.make_env`.
        against: names or import paths of traffics to compare with.
        data: which recordings, ``{"path": FILE}``; without, those of the recordings' folder, or what ships.
        quick: a check that it runs.
        folder: where JSON and figures go; None: a new one below ``outputs/realism``.
        env, overrides: keys of the command (``vehicle_km``, ``long_s``, ``resamples``, ...) or of the environment.

    Raises:
        UserError: a wrong value, or recordings that cannot be read.
    """
    from ganlane.realism import realism as command

    parts: dict[str, Option] = {"traffic": traffic, "env": env, "data": data}
    config = command_config(RealismConfig, parts, {**overrides, "against": list(against), "quick": quick})
    home, _ = run_in(folder, "realism", command, config)
    return Run(home, results_of(home))


def bench(
    suite: str = "sim",
    *,
    quick: bool = False,
    traffic: Option = "idm",
    env: Option = "highway",
    folder: str | Path | None = None,
    **overrides: Any,
) -> Run:
    """Speed and memory, beside a peer measured in the same run.

    ::

        run = bench("sim", quick=True, batches=[1, 1024], threads=[1])
        polars.DataFrame(run.results["rows"])

    On the command line: ``ganlane bench suite=sim quick=true 'batches=[1,1024]' 'threads=[1]'``.

    Args:
        suite: what to measure.
        quick: a few seconds in all.
        traffic: as in :func:`ganlane.api.make_env`.
        folder: where the results go; None: a new one below ``outputs/bench``.
        env, overrides: keys of the command (``batches``, ``modes``, ``peers``, ...) or of the environment.

    Raises:
        UserError: a wrong value.
    """
    from ganlane.bench import bench as command

    if overrides.get("report") is not None:
        raise UserError("report: tables go into a document with the command only; run ganlane bench report=FILE.")
    parts: dict[str, Option] = {"traffic": traffic, "env": env}
    config = command_config(BenchConfig, parts, {**overrides, "suite": suite, "quick": quick})
    home, _ = run_in(folder, "bench", command, config)
    return Run(home, results_of(home))
