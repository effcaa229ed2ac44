"""Lane changes laid over a traffic model that knows none: the paper's literal ones and calibrated ones."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ganlane.parameters.driving import IdmParameters, MobilParameters
from ganlane.sim.hazard import distance_hazard, literal_hazard, random_side
from ganlane.sim.idm import TABLE_V
from ganlane.sim.lanes import settled
from ganlane.sim.mobil import one_at_a_time, safe_change, without_ego
from ganlane.sim.neighbours import Scene, perceive
from ganlane.sim.random import Purpose, Stream, normal, uniform
from ganlane.sim.road import Road
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.sequential import Overlay


@dataclass(frozen=True)
class LiteralChanges:
    """Equations 9 to 11 as printed.

    Attributes:
        mean_steps: ``t_m``, in steps of 0.1 s.
        lateral_speed_mps: mean of the Gaussian of lateral speeds, m/s.
        lateral_speed_sd_mps: its standard deviation, m/s.
        slowest_mps: a drawn speed below this is raised to it, so that every change ends.
    """

    mean_steps: float = 2218.0
    lateral_speed_mps: float = 0.81
    lateral_speed_sd_mps: float = 0.33
    slowest_mps: float = 0.3


class LiteralLaneChange(Overlay):
    """The paper's lane changes: hazard ``t / t_m`` per step, blind, at a lateral speed drawn per change.

    Memory: steps since the last change ended, and the lateral speed of the change under way (m/s, to the left
    is positive, 0 without one).
    """

    memory_fields = {"clock": ((), torch.int64), "lateral_speed": ((), None)}  # noqa: RUF012

    def __init__(
        self, road: Road | None = None, stream: int = Stream.TRAIN, changes: LiteralChanges | None = None
    ) -> None:
        super().__init__(road, stream)
        self.changes = changes or LiteralChanges()

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> dict[str, Tensor]:
        """The clock starts at 0, as the paper's does after each change."""
        return {"clock": torch.zeros_like(vehicles.target_lane), "lateral_speed": torch.zeros_like(vehicles.x)}

    def _start(
        self, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Side of the changes that start now (0: none) and lateral speed drawn for them (m/s, at least slowest)."""
        c, m = self.changes, vehicles.x.shape[1]
        dtype = vehicles.x.dtype
        u = uniform(key, step, m, [Purpose.LANE_CHANGE_HAZARD, Purpose.LANE_CHANGE_SIDE], dtype)
        gauss = normal(key, step, m, [Purpose.LANE_CHANGE_SPEED], dtype)[..., 0]
        idle = memory["lateral_speed"] == 0
        starts = idle & vehicles.valid & (u[..., 0] < literal_hazard(memory["clock"].to(dtype), c.mean_steps))
        side = random_side(u[..., 1], vehicles.target_lane, self.road.lanes)
        pace = (c.lateral_speed_mps + c.lateral_speed_sd_mps * gauss).clamp_min(c.slowest_mps)
        return torch.where(starts, side, 0), pace

    def rewrite(
        self, vehicles: Vehicles, moved: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor
    ) -> tuple[Vehicles, dict[str, Tensor]]:
        """Start changes, and move those under way sideways at their own speed until they arrive.

        Whoever's target lane was set back on the way (:class:`ganlane.traffic.AbortedLaneChange`) returns as fast.
        """
        side, pace = self._start(vehicles, memory, key, step)
        target = vehicles.target_lane + side
        pace = torch.where(side != 0, pace, memory["lateral_speed"].abs())
        changing = pace != 0
        remaining = self.road.centre_of(target, vehicles.y.dtype) - vehicles.y
        lateral = torch.copysign(pace, remaining)
        stride = lateral * self.dt
        arrives = changing & (remaining.abs() <= stride.abs())
        y = vehicles.y + torch.where(arrives, remaining, stride)
        heading = torch.atan(lateral / vehicles.speed.clamp_min(1.0))
        clock = torch.where(changing, 0, memory["clock"] + 1)
        moved = moved.with_(
            target_lane=target,
            y=torch.where(changing, y, moved.y),
            heading=torch.where(changing, heading, moved.heading),
        )
        return moved, {"clock": clock, "lateral_speed": torch.where(arrives, 0.0, lateral)}


@dataclass(frozen=True)
class CalibratedChanges:
    """A rate per kilometre driven, and what makes a gap good enough.

    Attributes:
        per_km: hazard of *wishing* for a change. It is set so that the changes *measured in the simulation* come
            at the rate of the data; waiting for a gap makes the two differ.
        patience_s: a wish that finds no gap for so long is given up.
        safe_deceleration: nobody may be asked to brake harder, by IDM, m/s2.
        exclusive_m: nobody goes while another is on the way into the same lane within this distance; of several that
            want to go at once only the foremost does.
    """

    per_km: float = 0.92
    patience_s: float = 20.0
    safe_deceleration: float = 2.0
    exclusive_m: float = 60.0


class CalibratedLaneChange(Overlay):
    """Lane changes at the recorded rate, each behind a gap check that looks at closing speeds.

    Only the target lane is set: the model below drives there. Memory: the side wished for (-1, 0, 1) and how many
    steps it has been wished for.
    """

    memory_fields = {"wish": ((), torch.int64), "waited": ((), torch.int64)}  # noqa: RUF012

    def __init__(
        self,
        road: Road | None = None,
        stream: int = Stream.TRAIN,
        changes: CalibratedChanges | None = None,
        idm: IdmParameters = TABLE_V,
    ) -> None:
        super().__init__(road, stream)
        self.changes, self.idm = changes or CalibratedChanges(), idm
        limits = {name: getattr(self.changes, name) for name in ("safe_deceleration", "exclusive_m")}
        self._limits = MobilParameters(**limits)

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> dict[str, Tensor]:
        """Nobody wishes for anything."""
        zero = torch.zeros_like(vehicles.target_lane)
        return {"wish": zero, "waited": zero.clone()}

    def _wishes(self, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor) -> Tensor:
        """The standing wish, or a new one."""
        u = uniform(
            key,
            step,
            vehicles.x.shape[1],
            [Purpose.LANE_CHANGE_HAZARD, Purpose.LANE_CHANGE_SIDE],
            vehicles.x.dtype,
        )
        comes = u[..., 0] < distance_hazard(vehicles.speed, self.changes.per_km, self.dt)
        side = random_side(u[..., 1], vehicles.target_lane, self.road.lanes)
        free = settled(vehicles, self.road) & vehicles.valid
        return without_ego(torch.where(memory["wish"] != 0, memory["wish"], torch.where(comes & free, side, 0)))

    def _contested(self, scene: Scene, lane: Tensor) -> Tensor:
        """Whether somebody near is on the way into ``lane`` [N, M] already; the ego keeps its plans to itself."""
        vehicles = scene.vehicles
        target = vehicles.target_lane.to(lane.dtype)
        under_way = (self.road.lane_of(vehicles.y) != target) & vehicles.valid
        under_way = torch.cat((torch.zeros_like(under_way[:, :1]), under_way[:, 1:]), dim=1)
        near = torch.minimum(scene.ahead, scene.behind) < self.changes.exclusive_m
        return (near & under_way[:, None, :] & (target[:, None, :] == lane[:, :, None])).any(-1)

    def rewrite(
        self, vehicles: Vehicles, moved: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor
    ) -> tuple[Vehicles, dict[str, Tensor]]:
        """Set the target lane of those whose wish finds a gap."""
        wish = self._wishes(vehicles, memory, key, step)
        scene = perceive(vehicles, self.road)
        lane = (vehicles.target_lane + wish).to(vehicles.x.dtype)
        safe = safe_change(scene, lane, self.idm, self._limits)
        wanted = torch.where(safe & ~self._contested(scene, lane), wish, 0)
        goes = one_at_a_time(scene, wanted, self.idm, self._limits)
        waited = torch.where(wish != 0, memory["waited"] + 1, 0)
        given_up = waited >= round(self.changes.patience_s / self.dt)
        rest = torch.where((goes != 0) | given_up, 0, wish)
        moved = moved.with_(target_lane=vehicles.target_lane + goes)
        return moved, {"wish": rest, "waited": torch.where(rest == 0, 0, waited)}
