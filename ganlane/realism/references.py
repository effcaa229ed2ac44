"""What a traffic is compared with: recorded driving as histograms that ship, and reference drivers.

Two drivers mark the ends of the scale (random driving, constant velocity); :class:`HeadwayIdm` is a control.
The file that ships holds histograms and derived numbers, never an excerpt of a recording.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ganlane.errors import UserError
from ganlane.evaluation.statistics import Array
from ganlane.files import CHECKPOINTS, PLACE, has_checksum, note_without_checksum, write_json
from ganlane.generator.closed_loop import headway_from_uniform
from ganlane.realism.measures import QUANTITIES, Measured, ceiling, lane_change_rate
from ganlane.sim.idm import following_acceleration
from ganlane.sim.neighbours import perceive
from ganlane.sim.random import Purpose, uniform
from ganlane.sim.state import Vehicles
from ganlane.traffic.base import TrafficModule
from ganlane.traffic.overlays import random_side

#: The file that ships.
SHIPPED_REFERENCE = CHECKPOINTS / "realism_us101.json"
_KIND = "ganlane realism reference"


@dataclass(frozen=True)
class Reference:
    """Recorded driving as histograms and rates.

    Attributes:
        source: where it was recorded.
        units: names of the scenes.
        counts: by quantity, [units, bins].
        quantiles: by quantity, by level as text.
        lane_changes, vehicle_km: from 3 s after each vehicle's first frame.
        whole: lane changes and vehicle-km of all frames, and ``speed_spread_mps``; long runs are compared with these.
        floors: by driver (``random``, ``constant_velocity``), by quantity: its distance from here.
    """

    source: str
    units: list[str]
    counts: Mapping[str, Array]
    quantiles: Mapping[str, Mapping[str, float | None]]
    lane_changes: int
    vehicle_km: float
    whole: Mapping[str, float]
    floors: Mapping[str, Mapping[str, float]]

    @classmethod
    def of(cls, measured: Measured, units: Sequence[str], whole: Mapping[str, float], source: str) -> Reference:
        """The reference that measured recordings give, without floors."""
        changes, km = measured.lane_changes, measured.vehicle_km
        return cls(source, list(units), measured.counts, measured.quantiles(), changes, km, whole, floors={})

    def summary(self) -> dict[str, Any]:
        """As :meth:`Measured.summary`."""
        return {**lane_change_rate(self.lane_changes, self.vehicle_km), "quantiles": self.quantiles}

    @property
    def spread_mps(self) -> float:
        """Recorded spread of speeds within a frame, its mean over the frames, m/s."""
        return self.whole["speed_spread_mps"]

    def rate(self) -> dict[str, Any]:
        """Lane changes per vehicle-km of the whole recording, with its exact interval."""
        return lane_change_rate(int(self.whole["lane_changes"]), self.whole["vehicle_km"])

    def save(self, path: Path) -> None:
        """Write as JSON, atomically."""
        ceilings = {quantity: ceiling(counts) for quantity, counts in self.counts.items()}
        plain = {**vars(self), "counts": {name: value.astype(int).tolist() for name, value in self.counts.items()}}
        write_json(path, {"kind": _KIND, "checksum": PLACE, "bins": _bins(), "ceilings": ceilings, **plain})

    @classmethod
    def load(cls, path: Path) -> Reference:
        """What :meth:`save` wrote.

        Raises:
            UserError: no such file, a damaged one, another file, or one with other bins.
        """
        try:
            content = path.read_bytes()
            whole = has_checksum(content, path)
            numbers = json.loads(content)
            if numbers.pop("kind") != _KIND:
                raise ValueError("another kind of file")
            if numbers.pop("bins") != _bins():
                raise ValueError("its histograms have other bins")
            for derived in ("ceilings", "checksum"):
                numbers.pop(derived, None)
            counts = {name: np.asarray(value, dtype=np.float64) for name, value in numbers.pop("counts").items()}
            reference = cls(counts=counts, **numbers)
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise UserError(
                f"{path}: not the histograms of recorded driving that the realism card needs ({error}); give the "
                "recordings with data.path=FILE."
            ) from error
        if not whole:
            note_without_checksum(path)
        return reference


def _bins() -> dict[str, list[float]]:
    """Low edge, high edge and number of the bins, by quantity."""
    return {name: [bins.low, bins.high, bins.number] for name, bins in QUANTITIES.items()}


class ConstantVelocity(TrafficModule):
    """Every vehicle keeps its lane and the speed at which it entered."""

    def move(self, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor) -> tuple[Vehicles, dict]:
        """One step along the road."""
        v = vehicles
        return v.with_(x=v.x + v.speed * self.dt, acceleration=torch.zeros_like(v.speed)), memory


class RandomDriving(TrafficModule):
    """Drivers that ignore all others: the far end of the scale.

    An acceleration is drawn every second, uniform up to 3 m/s2 either way; a lane change to a random side starts at a
    constant hazard, every 20 s on average, and takes 4 s. Speeds are never negative.
    """

    hardest, every_s, change_s = 3.0, 20.0, 4.0

    def move(self, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor) -> tuple[Vehicles, dict]:
        """One step: the second's acceleration, and towards the target lane."""
        v, m, dtype = vehicles, vehicles.x.shape[1], vehicles.x.dtype
        pace = uniform(key, torch.div(step, 10, rounding_mode="floor"), m, [Purpose.ACCELERATION], dtype)[..., 0]
        drawn = uniform(key, step, m, [Purpose.LANE_CHANGE_HAZARD, Purpose.LANE_CHANGE_SIDE], dtype)
        remaining = self.road.centre_of(v.target_lane, dtype) - v.y
        starts = (drawn[..., 0] < self.dt / self.every_s) & (remaining.abs() < 0.3)
        side = torch.where(starts, random_side(drawn[..., 1], v.target_lane, self.road.lanes), 0)
        target = v.target_lane + side
        stride = self.road.lane_width_m * self.dt / self.change_s
        aside = (remaining / stride).clamp(-1.0, 1.0) * stride
        speed = (v.speed + self.hardest * (2.0 * pace - 1.0) * self.dt).clamp_min(0.0)
        moved = v.with_(
            x=v.x + 0.5 * (v.speed + speed) * self.dt,
            y=v.y + aside,
            speed=speed,
            acceleration=(speed - v.speed) / self.dt,
            target_lane=target,
        )
        return moved, memory


class HeadwayIdm(TrafficModule):
    """IDM without lane changes, each driver with its own headway: generated traffic without its network.

    A control, none of the shipped traffics: Table V gives everybody the same headway. Memory: ``headway`` [N, M]
    in s, drawn from the recorded distribution, or taken from a recorded start.
    """

    memory_fields = {"headway": ((), None)}  # noqa: RUF012

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> dict[str, Tensor]:
        """A random headway for each driver."""
        u = uniform(key, -1, vehicles.x.shape[1], [Purpose.TRAIT_HEADWAY], vehicles.x.dtype)[..., 0]
        return {"headway": headway_from_uniform(u)}

    def move(self, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor) -> tuple[Vehicles, dict]:
        """One step along the road."""
        v = vehicles
        wanted = following_acceleration(perceive(v, self.road), headway_s=memory["headway"])
        speed = (v.speed + wanted * self.dt).clamp_min(0.0)
        x = v.x + 0.5 * (v.speed + speed) * self.dt
        return v.with_(x=x, speed=speed, acceleration=(speed - v.speed) / self.dt), memory
