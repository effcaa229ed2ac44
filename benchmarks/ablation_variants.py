"""The variants of the generated traffics: each as it is, and with one thing changed at a time.

One change is no option of the package: a calibrated generator that follows plans of several steps.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

from torch import Tensor, nn

from ganlane.errors import UserError
from ganlane.generator import Generator, load_generator
from ganlane.generator.closed_loop import COMMON_SPEED_MPS
from ganlane.generator.networks import Observation
from ganlane.sim.idm import TABLE_V
from ganlane.sim.spawn import TABLE_II, SpawnParameters
from ganlane.sim.state import Road
from ganlane.traffic import CalibratedLaneChange, TrafficSequential
from ganlane.traffic.presets import gan_calibrated_traffic, gan_traffic
from ganlane.traffic.social_gan import AnchoredGanTraffic, GeneratedTraffic

#: Steps of a plan that are driven before predicting again.
PLANS = (2, 4, 8)
#: Everybody drives alike: Table V's headway, and one desired speed.
COMMON_SPAWN = replace(TABLE_II, desired_speed_mps=(COMMON_SPEED_MPS, COMMON_SPEED_MPS))
PRESETS = {"gan": gan_traffic, "gan_calibrated": gan_calibrated_traffic}
Change = Callable[[TrafficSequential], None]


class PlanningGenerator(Generator):
    """``generator`` asked for one step at a time, but looking only every ``steps``.

    What execute_k is to ``gan``.
    """

    def __init__(self, generator: Generator, steps: int) -> None:
        super().__init__(generator.sizes)
        self.load_state_dict(generator.state_dict())
        self.eval().requires_grad_(False)
        self.steps, self.ahead = steps, list[Tensor]()

    def summarise(self, now: Observation) -> Tensor:
        """The context; nothing while the plan lasts."""
        return now.displacement if self.ahead else super().summarise(now)

    def decode(self, context: Tensor, noise: Tensor, now: Observation, steps: int) -> Tensor:
        """The next step of the plan [..., 1, 2].

        All rows began together, so all look at the same time.
        """
        if not self.ahead:
            self.ahead = list(super().decode(context, noise, now, self.steps).unbind(-2))
        return self.ahead.pop(0)[..., None, :]


def generator_of(traffic: TrafficSequential) -> GeneratedTraffic:
    """The chain's first part."""
    return cast(GeneratedTraffic, traffic.parts["generator"])


def planning(steps: int, traffic: TrafficSequential) -> None:
    """Follow predictions of so many steps to their end."""
    generator_of(traffic).generator = PlanningGenerator(generator_of(traffic).generator, steps)


def without_residual(traffic: TrafficSequential) -> None:
    """The network's output is 0: the anchor alone drives, with the drivers' own headways."""
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
    """Another :class:`ganlane.traffic.overlays.CalibratedChanges`."""
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
        weights = Path(self.options.get("path", "")).stem
        return re.sub(r"[^a-z0-9]+", "_", f"{self.preset} {self.name} {weights}".lower()).strip("_")


def gan_variants() -> list[Variant]:
    """Of the paper's preset."""
    plans = [Variant("gan", f"execute_k = {steps}", {"execute_k": steps}) for steps in PLANS]
    parts = {"sudden accelerations": "acceleration", "literal lane changes": "lane_change"}
    return [
        Variant("gan", "as it is", {}),
        Variant("gan", "without the guard", {"guard": False}),
        *plans,
        Variant("gan", "without latent noise (z = 0)", {"noise_scale": 0.0}),
        *(
            Variant("gan", f"without {words}", {}, partial(without, part))
            for words, part in parts.items()
        ),
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
        "without the gap check": (partial(with_changes, {"safe_deceleration": 1e6}), TABLE_II),
        "without giving way to others' changes": (
            partial(with_changes, {"exclusive_m": 0.0}),
            TABLE_II,
        ),
    }
    plans = [
        Variant("gan_calibrated", f"plans of {steps} steps", {}, partial(planning, steps))
        for steps in PLANS
    ]
    return [
        Variant("gan_calibrated", "as it is", {}),
        Variant("gan_calibrated", "without latent noise (z = 0)", {"noise_scale": 0.0}),
        *(
            Variant("gan_calibrated", name, {}, change, spawn)
            for name, (change, spawn) in changes.items()
        ),
        Variant("gan_calibrated", "without lane changes", {"changes_per_km": 0.0}),
        *plans,
    ]


def fitted_variant(label_and_file: str) -> Variant:
    """``LABEL=FILE``: other weights in their own preset's chain."""
    label, _, file = label_and_file.partition("=")
    if not label or not file:
        raise UserError(
            f"--fitted {label_and_file}: expected LABEL=FILE, a name and the weights of a generator."
        )
    return Variant(preset_of(file), label, {"path": file})


def preset_of(weights: str | Path) -> str:
    """The traffic whose generator these are the weights of: gan or gan_calibrated."""
    return {"paper": "gan", "calibrated": "gan_calibrated"}[load_generator(weights)[1]["preset"]]
