"""What does each option of the generated traffics do? The closed loop, driven with one of them
changed at a time.

    python -m benchmarks.traffic_ablations
    python -m benchmarks.traffic_ablations --fits docs/reproduce/generators/*.safetensors --report
    docs/traffic.md

Vehicles start as the simulator's episodes do (Table II), without an ego, and drive ``--seconds`` an
episode until a variant has its vehicle-km. Every variant drives with the weights that ship and with
each of ``--fits``, the same recipe fitted with other seeds; a cell then holds the mean, lowest and
highest of the fits, a count their sum. ``--fitted LABEL=FILE`` adds other weights as rows of their
own. The numbers of every variant and fit are kept in a file in ``--folder``, so a run that was
stopped goes on where it was.

Plans of several steps for the calibrated traffic are no option of the package
(:mod:`benchmarks.ablation_variants`).
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path
from statistics import fmean, median
from typing import Any

import torch

from benchmarks.ablation_variants import (
    Variant,
    calibrated_variants,
    fitted_variant,
    gan_variants,
    preset_of,
)
from benchmarks.script import ReportSection, add_report, make_parser, run_script
from ganlane.evaluation import machine_sentence
from ganlane.evaluation.table import NOTHING, Table, with_interval
from ganlane.files import write_json
from ganlane.realism.long_runs import LongRun, LongRunParameters
from ganlane.runtime import keep_freed_memory
from ganlane.sim.state import Road
from ganlane.traffic import TrafficModule

BEGIN, END = "<!-- begin traffic ablations -->", "<!-- end traffic ablations -->"
HEADINGS = (
    "variant",
    "vehicle-km",
    "lane changes per vehicle-km",
    "overlaps per 1000 vehicle-km",
    "off road",
    "mean speed, m/s",
    "spread, m/s",
    "acceleration 5 %, 95 %, m/s²",
    "the guard's share, %",
    "physics steps/CPU-s",
)


class StepClock:
    """CPU seconds of every call of a traffic, all threads."""

    def __init__(self, traffic: TrafficModule) -> None:
        self.seconds, self._begun = list[float](), 0.0
        traffic.register_forward_pre_hook(self._begin)
        traffic.register_forward_hook(self._end)

    def _begin(self, *_: Any) -> None:
        self._begun = time.process_time()

    def _end(self, *_: Any) -> None:
        self.seconds.append(time.process_time() - self._begun)


def drive(variant: Variant, parameters: LongRunParameters, batch: int) -> dict[str, Any]:
    """Drive ``batch`` episodes at a time until the wanted vehicle-km are covered.

    Returns:
        The numbers of a long run; at the end of the episodes the mean speed and its mean standard
        deviation within an episode, m/s; physics steps per CPU second.
    """
    run = LongRun(Road(), parameters)
    ends: list[tuple[float, float]] = []
    seconds: list[float] = []
    while not run.finished:
        traffic = variant.make()
        clock = StepClock(traffic)
        last = run.drive(traffic, batch).speed[-1].astype("float64")
        ends.append((float(last.mean()), float(last.std(axis=-1, ddof=1).mean())))
        seconds += clock.seconds
    mean, spread = (sum(values) / len(values) for values in zip(*ends))
    return {
        **run.numbers(),
        "mean_speed_mps": mean,
        "spread_mps": spread,
        "physics_steps_per_cpu_s": batch / median(seconds),
    }


def cells(fits: Sequence[dict[str, Any]]) -> list[str]:
    """A row of the table behind its name, of one fit or several."""
    quantiles = [each["acceleration_quantiles"].values() for each in fits]
    return [
        f"{sum(each['vehicle_km'] for each in fits):.0f}",
        _over_fits(fits, lambda each: each["lane_changes_per_vehicle_km"], 2),
        _over_fits(
            fits,
            lambda each: each["overlaps_per_1000_vehicle_km"],
            1,
            "overlaps_per_1000_vehicle_km_ci",
        ),
        str(sum(each["off_road"] for each in fits)),
        _over_fits(fits, lambda each: each["mean_speed_mps"], 1),
        _over_fits(fits, lambda each: each["spread_mps"], 2),
        ", ".join(f"{sum(levels) / len(fits):.2f}" for levels in zip(*quantiles)),
        _over_fits(
            fits,
            lambda each: None if each["guard_share"] is None else 100.0 * each["guard_share"],
            1,
        ),
        f"{sum(each['physics_steps_per_cpu_s'] for each in fits) / len(fits) / 1000:.1f} k",
    ]


def _over_fits(
    fits: Sequence[dict[str, Any]],
    value: Callable[[dict[str, Any]], float | None],
    digits: int,
    interval: str = "",
) -> str:
    """Mean, lowest and highest of several fits.

    The value of a single one, with its ``interval`` if it has one.
    """
    values = [found for each in fits if (found := value(each)) is not None]
    if not values:
        return NOTHING
    bounds = (min(values), max(values)) if len(fits) > 1 else fits[0].get(interval)
    return with_interval({"mean": fmean(values), "mean_ci": bounds}, "mean", digits)


def table(rows: Sequence[tuple[Variant, Sequence[dict[str, Any]]]]) -> str:
    """Markdown: the variants of each preset under its name."""
    lines = [[f"`{variant.preset}`, {variant.name}", *cells(fits)] for variant, fits in rows]
    return Table("", HEADINGS, lines).markdown(heading=False)


def settings(variant: Variant, options: argparse.Namespace) -> dict[str, Any]:
    """What a variant's numbers depend on: its own options, with the weights, and those of the run."""
    run = {
        name: getattr(options, name)
        for name in ("vehicle_km", "vehicles", "batch", "seconds", "seed")
    }
    return {"options": variant.options, **run}


def with_each_fit(
    variant: Variant, fits: Mapping[Path, str], options: argparse.Namespace
) -> list[dict[str, Any]]:
    """The numbers of a variant with the weights that ship, then with the ``fits`` (and their
    presets) of its own.
    """
    if "path" in variant.options:
        return [driven(variant, options)]
    others = [file for file, preset in fits.items() if preset == variant.preset]
    variants = [
        variant,
        *(replace(variant, options={**variant.options, "path": str(file)}) for file in others),
    ]
    return [driven(each, options) for each in variants]


def driven(variant: Variant, options: argparse.Namespace) -> dict[str, Any]:
    """The numbers of a variant, from its file if it was driven with these settings before."""
    path, wanted = options.folder / f"{variant.slug}.json", settings(variant, options)
    if path.is_file():
        kept = json.loads(path.read_text(encoding="utf-8"))
        if kept["settings"] == wanted:
            return kept["numbers"]
    begun = time.monotonic()
    asked = LongRunParameters(
        options.vehicles, options.vehicle_km, options.seconds, options.seed, variant.spawn
    )
    numbers = drive(variant, asked, options.batch)
    write_json(path, {"settings": wanted, "numbers": numbers})
    line = f"{variant.slug}: {numbers['vehicle_km']:.0f} vehicle-km"
    print(f"{line} in {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)
    return numbers


def section(options: argparse.Namespace, text: str) -> str:
    """The table with the command and the machine."""
    given = options.given[:]
    if options.report is not None and "--report" in given:
        del given[given.index("--report") : given.index("--report") + 2]
    command = shlex.join(["python", "-m", "benchmarks.traffic_ablations", *given])
    return "\n".join(
        [
            f"\nWritten by the command on {date.today()}:\n\n    {command}\n",
            f"Taken on: {machine_sentence([torch.get_num_threads()])} {options.vehicles} vehicles without an ego, "
            f"{options.batch} episodes side by side, {options.seconds:g} s each. {_meaning(options)}\n\n{text}\n",
        ]
    )


def _meaning(options: argparse.Namespace) -> str:
    """What the brackets hold."""
    if options.fits:
        return "Brackets: lowest and highest of the fits; vehicle-km and off-road events are their sums."
    return "Brackets: exact 95 % interval."


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--vehicle-km", type=float, default=200.0, help="at least, per variant")
    parser.add_argument("--vehicles", type=int, default=9)
    parser.add_argument("--batch", type=int, default=128, help="episodes side by side")
    parser.add_argument("--seconds", type=float, default=20.0, help="of an episode")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--fits", nargs="*", default=[], type=Path, help="weights fitted with other seeds"
    )
    parser.add_argument(
        "--fitted", action="append", default=[], metavar="LABEL=FILE", help="further weights"
    )
    parser.add_argument("--only", nargs="*", help="variants whose name holds one of these words")
    parser.add_argument("--folder", type=Path, default=Path("outputs/traffic_ablations"))
    add_report(parser, BEGIN, END)
    options = parser.parse_args(arguments)
    options.given = list(arguments)
    return options


def measure(options: argparse.Namespace) -> str:
    """Drive all variants; the table, in the document too where one is named."""
    keep_freed_memory()
    document = ReportSection(options.report, BEGIN, END)
    chosen = [*gan_variants(), *calibrated_variants(), *map(fitted_variant, options.fitted)]
    if options.only:
        chosen = [
            each
            for each in chosen
            if any(word in f"{each.preset} {each.name}" for word in options.only)
        ]
    fits = {file: preset_of(file) for file in options.fits}
    text = table([(variant, with_each_fit(variant, fits, options)) for variant in chosen])
    document.write(section(options, text))
    return text


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure; the exit status."""
    return run_script(measure, parse(sys.argv[1:] if arguments is None else arguments))


if __name__ == "__main__":
    sys.exit(main())
