"""What does each option of the generated traffics do? The closed loop, driven with one of them changed at a time.

    python benchmarks/traffic_ablations.py
    python benchmarks/traffic_ablations.py --report docs/traffic.md

Vehicles start as the simulator's episodes do (Table II), without an ego, and drive ``--seconds`` an episode until a
variant has its vehicle-km. The weights are those that ship; ``--fitted LABEL=FILE`` adds others. Every variant's
numbers stand in a file of their own in ``--folder``, so a run that was stopped goes on where it stood.

Two variants are no option of the package: the generator in bfloat16, and plans of several steps for the calibrated
traffic (:mod:`benchmarks.ablations.networks`).
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

import torch

from ganlane.benchmarks.report import machine_sentence
from ganlane.benchmarks.script import ReportSection, add_report, parser_of, run_script
from ganlane.files import write_json
from ganlane.realism.long_runs import LongRunParameters
from ganlane.runtime import keep_freed_memory

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.ablations.driving import drive
from benchmarks.ablations.tables import table
from benchmarks.ablations.variants import Variant, calibrated_variants, fitted_variant, gan_variants

BEGIN, END = "<!-- begin traffic ablations -->", "<!-- end traffic ablations -->"


def settings(told: argparse.Namespace) -> dict[str, Any]:
    """What a variant's numbers depend on."""
    return {name: getattr(told, name) for name in ("vehicle_km", "vehicles", "batch", "seconds", "seed")}


def driven(variant: Variant, told: argparse.Namespace) -> dict[str, Any]:
    """The numbers of a variant, from its file if it was driven with these settings before."""
    path, wanted = told.folder / f"{variant.slug}.json", settings(told)
    if path.is_file():
        kept = json.loads(path.read_text(encoding="utf-8"))
        if kept["settings"] == wanted:
            return kept["numbers"]
    begun = time.monotonic()
    asked = LongRunParameters(told.vehicles, told.vehicle_km, told.seconds, told.seed, variant.spawn)
    numbers = drive(variant, asked, told.batch)
    write_json(path, {"settings": wanted, "numbers": numbers})
    line = f"{variant.preset}, {variant.name}: {numbers['vehicle_km']:.0f} vehicle-km"
    print(f"{line} in {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)
    return numbers


def section(told: argparse.Namespace, text: str) -> str:
    """The table with the command and the machine."""
    given = told.given[:]
    if told.report is not None and "--report" in given:
        del given[given.index("--report") : given.index("--report") + 2]
    command = shlex.join(["python", "benchmarks/traffic_ablations.py", *given])
    return "\n".join(
        [
            f"\nWritten by the command on {date.today()}:\n\n    {command}\n",
            f"Taken on: {machine_sentence([torch.get_num_threads()])} {told.vehicles} vehicles without an ego, "
            f"{told.batch} episodes side by side, {told.seconds:g} s each.\n\n{text}\n",
        ]
    )


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """What the command line says."""
    parser = parser_of(__doc__)
    parser.add_argument("--vehicle-km", type=float, default=200.0, help="at least, per variant")
    parser.add_argument("--vehicles", type=int, default=9)
    parser.add_argument("--batch", type=int, default=128, help="episodes side by side")
    parser.add_argument("--seconds", type=float, default=20.0, help="of an episode")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fitted", action="append", default=[], metavar="LABEL=FILE", help="further weights")
    parser.add_argument("--only", nargs="*", help="variants whose name holds one of these words")
    parser.add_argument("--folder", type=Path, default=Path("outputs/traffic_ablations"))
    add_report(parser, BEGIN, END)
    told = parser.parse_args(arguments)
    told.given = list(arguments)
    return told


def measure(told: argparse.Namespace) -> str:
    """Drive all variants; the table, in the document too where one is named."""
    keep_freed_memory()
    document = ReportSection(told.report, BEGIN, END)
    chosen = [*gan_variants(), *calibrated_variants(), *map(fitted_variant, told.fitted)]
    if told.only:
        chosen = [each for each in chosen if any(word in f"{each.preset} {each.name}" for word in told.only)]
    text = table([(variant, driven(variant, told)) for variant in chosen])
    document.write(section(told, text))
    return text


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure; the exit status."""
    return run_script(measure, parse(sys.argv[1:] if arguments is None else arguments))


if __name__ == "__main__":
    sys.exit(main())
