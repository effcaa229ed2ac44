"""What does each option of the generated traffics do? The closed loop, driven with one of them changed at a time.

    python benchmarks/traffic_ablations.py
    python benchmarks/traffic_ablations.py --report docs/traffic.md

Vehicles start as the simulator's episodes do (Table II), without an ego, and drive ``--seconds`` an episode until a
variant has its vehicle-km. The weights are those that ship; ``--fitted LABEL=FILE`` adds others. Every variant's
numbers stand in a file of their own in ``--folder``, so a run that was stopped goes on where it stood.

Two variants are no option of the package: the generator in bfloat16, and plans of several steps for the calibrated
traffic. They live here.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import date
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, cast

import torch
from torch import Tensor, nn

from ganlane.benchmarks.report import machine_sentence
from ganlane.errors import UserError
from ganlane.evaluation.realism.counters import EventCounter, GuardMeter, watched
from ganlane.evaluation.realism.long import LongRunParameters, drive_spawned
from ganlane.evaluation.realism.long_summary import Course, measured, summary
from ganlane.files import split_at_markers, write_between_markers, write_json
from ganlane.generator import Generator, load_generator
from ganlane.generator.lstm import MotionLSTM, motion_features
from ganlane.generator.networks import Observation
from ganlane.generator.pooling import PairPooling
from ganlane.generator.traits import COMMON_SPEED_MPS
from ganlane.memory import keep_freed_memory
from ganlane.sim.idm import TABLE_V
from ganlane.sim.road import Road
from ganlane.sim.spawn import TABLE_II, SpawnParameters
from ganlane.traffic import CalibratedLaneChange, TrafficModule, TrafficSequential
from ganlane.traffic.presets import gan_calibrated_traffic, gan_traffic
from ganlane.traffic.social_gan import AnchoredGanTraffic, GeneratedTraffic

BEGIN, END = "<!-- begin traffic ablations -->", "<!-- end traffic ablations -->"
#: Steps of a plan that are driven before predicting again.
PLANS = (2, 4, 8)
#: Everybody drives alike: Table V's headway, and one desired speed.
COMMON_SPAWN = replace(TABLE_II, desired_speed_mps=(COMMON_SPEED_MPS, COMMON_SPEED_MPS))
PRESETS = {"gan": gan_traffic, "gan_calibrated": gan_calibrated_traffic}
Change = Callable[[TrafficSequential], None]


# The generator in bfloat16: layers and states. Positions and displacements that are driven stay float32.


class Bfloat16Motion(MotionLSTM):
    """Projections in bfloat16; so are the recurrence and its state."""

    def project(self, displacement: Tensor, difference: Tensor) -> Tensor:
        """See :meth:`MotionLSTM.project`."""
        return self.input(torch.relu(self.embed(motion_features(displacement, difference).bfloat16())))


class Bfloat16Pooling(PairPooling):
    """Positions are made relative to the first vehicle before they lose digits (0.25 m at 60 m)."""

    def forward(self, hidden: Tensor, position: Tensor, displacement: Tensor, valid: Tensor) -> Tensor:
        """See :meth:`PairPooling.forward`."""
        near = (position - position[..., :1, :]).bfloat16()
        return super().forward(hidden, near, displacement.bfloat16(), valid)


class Bfloat16Generator(Generator):
    """``generator`` with its layers in bfloat16; its output is float32."""

    def __init__(self, generator: Generator) -> None:
        sizes = generator.sizes
        super().__init__(sizes)
        self.encoder = Bfloat16Motion(sizes.embedding, sizes.hidden)
        self.decoder = Bfloat16Motion(sizes.embedding, sizes.hidden)
        self.pooling = Bfloat16Pooling(sizes.hidden, sizes.pooling, sizes.pooled, sizes.neighbours)
        self.load_state_dict(generator.state_dict())
        self.bfloat16().eval().requires_grad_(False)

    def summarise(self, seen: Observation) -> Tensor:
        """See :meth:`Generator.summarise`."""
        return super().summarise(seen._replace(extra=seen.extra.bfloat16()))

    def decode(self, context: Tensor, noise: Tensor, seen: Observation, steps: int) -> Tensor:
        """See :meth:`Generator.decode`."""
        return super().decode(context, noise.bfloat16(), seen, steps).float()


class PlanningGenerator(Generator):
    """``generator`` asked for one step at a time, but looking only every ``steps``: what execute_k is to ``gan``."""

    def __init__(self, generator: Generator, steps: int) -> None:
        super().__init__(generator.sizes)
        self.load_state_dict(generator.state_dict())
        self.eval().requires_grad_(False)
        self.steps, self.ahead = steps, list[Tensor]()

    def summarise(self, seen: Observation) -> Tensor:
        """The context; nothing while the plan lasts."""
        return seen.displacement if self.ahead else super().summarise(seen)

    def decode(self, context: Tensor, noise: Tensor, seen: Observation, steps: int) -> Tensor:
        """The next step of the plan [..., 1, 2]; all rows began together, so all look at the same time."""
        if not self.ahead:
            self.ahead = list(super().decode(context, noise, seen, self.steps).unbind(-2))
        return self.ahead.pop(0)[..., None, :]


# What is changed.


def generator_of(traffic: TrafficSequential) -> GeneratedTraffic:
    """The chain's first part."""
    return cast(GeneratedTraffic, traffic.parts["generator"])


def in_bfloat16(traffic: TrafficSequential) -> None:
    """Run the generator in bfloat16."""
    generator_of(traffic).generator = Bfloat16Generator(generator_of(traffic).generator)


def planning(steps: int, traffic: TrafficSequential) -> None:
    """Follow predictions of so many steps to their end."""
    generator_of(traffic).generator = PlanningGenerator(generator_of(traffic).generator, steps)


def without_residual(traffic: TrafficSequential) -> None:
    """The network says 0: the anchor drives, with the drivers' own headways."""
    for weights in generator_of(traffic).generator.head.parameters():
        nn.init.zeros_(weights)


def with_anchor(settings: dict[str, Any], traffic: TrafficSequential) -> None:
    """Another anchor in the simulation; the weights were fitted with the shipped one."""
    part = cast(AnchoredGanTraffic, traffic.parts["generator"])
    part.anchor = replace(part.anchor, **settings)


def common_headway(traffic: TrafficSequential) -> None:
    """Table V's headway for all."""
    part = cast(AnchoredGanTraffic, traffic.parts["generator"])
    part.headway_quantiles_s = (TABLE_V.headway_s,) * len(part.headway_quantiles_s)


def with_changes(settings: dict[str, Any], traffic: TrafficSequential) -> None:
    """Another :class:`ganlane.traffic.lane_change.CalibratedChanges`."""
    old = cast(CalibratedLaneChange, traffic.parts["lane_change"])
    traffic.parts["lane_change"] = CalibratedLaneChange(
        old.road, old.stream, replace(old.changes, **settings), old.idm
    )


def without(part: str, traffic: TrafficSequential) -> None:
    """A shorter chain."""
    del traffic.parts[part]


@dataclass(frozen=True)
class Variant:
    """One row: a preset built with ``options``, then changed, on starts of ``spawn``."""

    preset: str
    name: str
    options: dict[str, Any]
    change: Change | None = None
    spawn: SpawnParameters = TABLE_II

    def make(self) -> TrafficSequential:
        """The traffic."""
        traffic = PRESETS[self.preset](Road(), **self.options)
        if self.change is not None:
            self.change(traffic)
        return traffic

    @property
    def slug(self) -> str:
        """Its name in a file's."""
        return re.sub(r"[^a-z0-9]+", "_", f"{self.preset} {self.name}".lower()).strip("_")


def gan_variants() -> list[Variant]:
    """Of the paper's preset."""
    plans = [Variant("gan", f"execute_k = {steps}", {"execute_k": steps}) for steps in PLANS]
    parts = {"sudden accelerations": "acceleration", "literal lane changes": "lane_change"}
    return [
        Variant("gan", "as it is", {}),
        Variant("gan", "without the guard", {"guard": False}),
        *plans,
        Variant("gan", "without latent noise (z = 0)", {"noise_scale": 0.0}),
        *(Variant("gan", f"without {words}", {}, partial(without, part)) for words, part in parts.items()),
        Variant("gan", "generator in bfloat16", {}, in_bfloat16),
    ]


def calibrated_variants() -> list[Variant]:
    """Of the calibrated preset."""
    changes: dict[str, tuple[Change, SpawnParameters]] = {
        "without the residual (anchor alone)": (without_residual, TABLE_II),
        "without the washout": (partial(with_anchor, {"washout_s": math.inf}), TABLE_II),
        "without further inputs": (partial(with_anchor, {"further_inputs": False}), TABLE_II),
        "without own headways": (common_headway, TABLE_II),
        "without traits (headway, desired speed)": (common_headway, COMMON_SPAWN),
        "wishes not kept until a gap comes": (partial(with_changes, {"patience_s": 0.1}), TABLE_II),
        "without the gap check": (partial(with_changes, {"safe_deceleration": math.inf}), TABLE_II),
        "without giving way to others' changes": (partial(with_changes, {"exclusive_m": 0.0}), TABLE_II),
    }
    plans = [Variant("gan_calibrated", f"plans of {steps} steps", {}, partial(planning, steps)) for steps in PLANS]
    return [
        Variant("gan_calibrated", "as it is", {}),
        Variant("gan_calibrated", "without latent noise (z = 0)", {"noise_scale": 0.0}),
        *(Variant("gan_calibrated", name, {}, change, spawn) for name, (change, spawn) in changes.items()),
        Variant("gan_calibrated", "without lane changes", {"changes_per_km": 0.0}),
        *plans,
        Variant("gan_calibrated", "generator in bfloat16", {}, in_bfloat16),
    ]


def fitted_variant(told: str) -> Variant:
    """``LABEL=FILE``: other weights in their own preset's chain."""
    label, _, file = told.partition("=")
    if not label or not file:
        raise UserError(f"--fitted {told}: expected LABEL=FILE; give a name and the weights of a generator.")
    preset = {"paper": "gan", "calibrated": "gan_calibrated"}[load_generator(file)[1]["preset"]]
    return Variant(preset, label, {"path": file})


# Driving and counting.


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


def drive(variant: Variant, told: argparse.Namespace) -> dict[str, Any]:
    """Drive until ``told.vehicle_km`` are covered; the numbers of a long run, spread and mean speed at the end."""
    parameters = LongRunParameters(told.vehicles, told.vehicle_km, told.seconds, told.seed, variant.spawn)
    events, meter, parts, ends, seconds = EventCounter(Road()), GuardMeter(), [], [], list[float]()
    while sum(part["vehicle_km"] for part in parts) < told.vehicle_km:
        traffic = variant.make()
        clock = StepClock(traffic)
        with watched(traffic, meter):
            course = drive_spawned(traffic, parameters, told.batch * len(parts), told.batch, events)
        parts.append(measured(course, Road()))
        ends.append(at_the_end(course))
        seconds += clock.seconds
        if parts[-1]["vehicle_km"] <= 0.0:
            break
    numbers = summary(parts, events, meter, told.batch * len(parts), told.vehicles)
    mean, spread = (sum(values) / len(values) for values in zip(*ends))
    return {
        **numbers,
        "mean_speed_mps": mean,
        "spread_mps": spread,
        "physics_steps_per_cpu_s": told.batch / median(seconds),
    }


def at_the_end(course: Course) -> tuple[float, float]:
    """Mean speed, and standard deviation within an episode, at the end of all episodes, m/s."""
    last = course.speed[-1].astype("float64")
    return float(last.mean()), float(last.std(axis=-1, ddof=1).mean())


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
    numbers = drive(variant, told)
    write_json(path, {"settings": wanted, "numbers": numbers})
    line = f"{variant.preset}, {variant.name}: {numbers['vehicle_km']:.0f} vehicle-km"
    print(f"{line} in {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)
    return numbers


# For a reader.

HEADINGS = (
    "variant",
    "vehicle-km",
    "lane changes per vehicle-km",
    "overlaps per 1000 vehicle-km [95 %]",
    "off road",
    "mean speed, m/s",
    "spread, m/s",
    "acceleration 5 %, 95 %, m/s²",
    "the guard's share",
    "physics steps/CPU-s",
)


def cells(numbers: dict[str, Any]) -> list[str]:
    """A row of the table behind its name."""
    changes, overlaps = numbers["lane_changes_per_vehicle_km"], numbers["overlaps_per_1000_vehicle_km"]
    low, high = numbers["overlaps_per_1000_vehicle_km_ci"] or (0.0, math.inf)
    slow, fast = numbers["acceleration_quantiles"].values()
    share = numbers["guard_share"]
    return [
        f"{numbers['vehicle_km']:.0f}",
        "-" if changes is None else f"{changes:.2f}",
        "-" if overlaps is None else f"{overlaps:.1f} [{low:.1f}, {high:.1f}]",
        str(numbers["off_road"]),
        f"{numbers['mean_speed_mps']:.1f}",
        f"{numbers['spread_mps']:.2f}",
        f"{slow:.2f}, {fast:.2f}",
        "-" if share is None else f"{100 * share:.1f} %",
        f"{numbers['physics_steps_per_cpu_s'] / 1000:.1f} k",
    ]


def table(rows: Sequence[tuple[Variant, dict[str, Any]]]) -> str:
    """Markdown: the variants of each preset under its name."""
    lines = [HEADINGS, ("---", *["---:"] * (len(HEADINGS) - 1))]
    text = [f"| {' | '.join(line)} |" for line in lines]
    text += [f"| {' | '.join([f'`{v.preset}`, {v.name}', *cells(numbers)])} |" for v, numbers in rows]
    return "\n".join(text)


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
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--vehicle-km", type=float, default=200.0, help="at least, per variant")
    parser.add_argument("--vehicles", type=int, default=9)
    parser.add_argument("--batch", type=int, default=128, help="episodes side by side")
    parser.add_argument("--seconds", type=float, default=20.0, help="of an episode")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fitted", action="append", default=[], metavar="LABEL=FILE", help="further weights")
    parser.add_argument("--only", nargs="*", help="variants whose name holds one of these words")
    parser.add_argument("--folder", type=Path, default=Path("outputs/traffic_ablations"))
    parser.add_argument("--report", type=Path, help=f"a document with the lines {BEGIN} and {END}")
    told = parser.parse_args(arguments)
    told.given = list(arguments)
    return told


def measure(told: argparse.Namespace) -> str:
    """Drive all variants; the table, in the document too where one is named."""
    if told.report is not None:
        split_at_markers(told.report, BEGIN, END)
    chosen = [*gan_variants(), *calibrated_variants(), *map(fitted_variant, told.fitted)]
    if told.only:
        chosen = [each for each in chosen if any(word in f"{each.preset} {each.name}" for word in told.only)]
    text = table([(variant, driven(variant, told)) for variant in chosen])
    if told.report is not None:
        write_between_markers(told.report, BEGIN, END, section(told, text))
    return text


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure; the exit status."""
    told = parse(sys.argv[1:] if arguments is None else arguments)
    torch.set_num_threads(1)
    keep_freed_memory()
    try:
        print(measure(told))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
