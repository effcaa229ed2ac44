"""Lane changes laid over a traffic model without any: the paper's literal ones and calibrated ones."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ganlane.parameters.driving import IdmParameters, MobilParameters
from ganlane.sim.idm import TABLE_V
from ganlane.sim.mobil import one_at_a_time, safe_change, without_ego
from ganlane.sim.neighbours import Scene, perceive
from ganlane.sim.random import Purpose, Stream, normal, uniform
from ganlane.sim.state import Road, Vehicles, lane_change_done
from ganlane.traffic.base import Memory, Moved, Overlay


def literal_hazard(clock: Tensor, mean_steps: float) -> Tensor:
    """Equation 10: probability ``t / t_m`` per step of a change, ``clock`` steps after the last one ended.

    Read literally the probability grows until a change is certain at ``t = t_m``, so the mean waiting time is about
    ``sqrt(pi t_m / 2)`` steps, not ``t_m``.
    """
    return (clock / mean_steps).clamp(0.0, 1.0)


def distance_hazard(speed: Tensor, changes_per_km: float, dt: float) -> Tensor:
    """Probability per step of ``dt`` s of starting a change, at a constant rate per kilometre driven."""
    return 1.0 - torch.exp(-speed * (dt * changes_per_km / 1000.0))


def random_side(u: Tensor, lane: Tensor, lanes: int | Tensor) -> Tensor:
    """A random side with a lane: -1 right, +1 left, 0 on a single-lane road; ``u`` uniform, ``lane`` int64."""
    left, right = lane < lanes - 1, lane > 0
    both = torch.where(u < 0.5, 1, -1)
    return torch.where(left & right, both, torch.where(left, 1, torch.where(right, -1, 0)))


def _hazard_and_side(vehicles: Vehicles, key: Tensor, step: Tensor) -> tuple[Tensor, ...]:
    """Uniform numbers [N, M] for whether a change starts, and to which side."""
    purposes: list[int] = [Purpose.LANE_CHANGE_HAZARD, Purpose.LANE_CHANGE_SIDE]
    return uniform(key, step, vehicles.x.shape[1], purposes, vehicles.x.dtype).unbind(-1)


@dataclass(frozen=True)
class LiteralChanges:
    """Equations 9 to 11 as printed.

    Attributes:
        mean_steps: ``t_m``, in steps of 0.1 s.
        lateral_speed_mps: mean of the Gaussian of lateral speeds, m/s.
        lateral_speed_sd_mps: its standard deviation, m/s.
        slowest_mps: lower bound of a drawn speed, so that every change ends, m/s.
    """

    mean_steps: float = 2218.0
    lateral_speed_mps: float = 0.81
    lateral_speed_sd_mps: float = 0.33
    slowest_mps: float = 0.3


class LiteralLaneChange(Overlay):
    """The paper's lane changes: hazard ``t / t_m`` per step, blind, at a lateral speed drawn per change.

    Memory: ``clock``, steps since the last change ended, and ``lateral_speed`` of the current change (m/s, positive
    to the left, 0 without one).
    """

    memory_fields = {"clock": ((), torch.int64), "lateral_speed": ((), None)}  # noqa: RUF012

    def __init__(
        self, road: Road | None = None, stream: int = Stream.TRAIN, changes: LiteralChanges | None = None
    ) -> None:
        super().__init__(road, stream)
        self.changes = changes or LiteralChanges()

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> Memory:
        """The clock starts at 0, as the paper's does after each change."""
        return {"clock": torch.zeros_like(vehicles.target_lane), "lateral_speed": torch.zeros_like(vehicles.x)}

    def _start(self, vehicles: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        """Side of the changes that start now (0: none), and the lateral speed drawn for them, m/s."""
        c, dtype = self.changes, vehicles.x.dtype
        u, u_side = _hazard_and_side(vehicles, key, step)
        gauss = normal(key, step, vehicles.x.shape[1], [Purpose.LANE_CHANGE_SPEED], dtype)[..., 0]
        idle = memory["lateral_speed"] == 0
        starts = idle & vehicles.valid & (u < literal_hazard(memory["clock"].to(dtype), c.mean_steps))
        side = random_side(u_side, vehicles.target_lane, self.road.lanes)
        pace = (c.lateral_speed_mps + c.lateral_speed_sd_mps * gauss).clamp_min(c.slowest_mps)
        return torch.where(starts, side, 0), pace

    def rewrite(self, vehicles: Vehicles, moved: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        """Start changes, and move current ones sideways at their own speed until they arrive.

        A vehicle whose target lane was set back (:class:`ganlane.traffic.AbortedLaneChange`) returns at that speed.
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
        moved = moved.with_(
            target_lane=target,
            y=torch.where(changing, y, moved.y),
            heading=torch.where(changing, heading, moved.heading),
        )
        clock = torch.where(changing, 0, memory["clock"] + 1)
        return moved, {"clock": clock, "lateral_speed": torch.where(arrives, 0.0, lateral)}


@dataclass(frozen=True)
class CalibratedChanges:
    """A rate per kilometre driven, and what makes a gap good enough.

    Attributes:
        per_km: hazard of *wishing* for a change, set so that the rate *measured in the simulation* is that of the
            data; waiting for a gap makes the two differ.
        patience_s: a wish that finds no gap for this long is given up, s.
        safe_deceleration: no vehicle has to brake harder, by IDM, m/s2.
        exclusive_m: a change does not start while another vehicle is moving into the same lane within this distance;
            of several that would start at once only the foremost does, m.
    """

    per_km: float = 0.92
    patience_s: float = 20.0
    safe_deceleration: float = 2.0
    exclusive_m: float = 60.0


class CalibratedLaneChange(Overlay):
    """Lane changes at the recorded rate, after a gap check that considers closing speeds.

    Only the target lane is set: the model below drives there. Memory: ``wish``, the desired side (-1, 0, 1), and
    ``waited``, the number of steps since it began.
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
        self._limits = MobilParameters(
            safe_deceleration=self.changes.safe_deceleration, exclusive_m=self.changes.exclusive_m
        )

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> Memory:
        """No wishes."""
        zero = torch.zeros_like(vehicles.target_lane)
        return {"wish": zero, "waited": zero.clone()}

    def _wishes(self, vehicles: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Tensor:
        """The current wish, or a new one."""
        u, u_side = _hazard_and_side(vehicles, key, step)
        comes = u < distance_hazard(vehicles.speed, self.changes.per_km, self.dt)
        side = random_side(u_side, vehicles.target_lane, self.road.lanes)
        free = lane_change_done(vehicles, self.road) & vehicles.valid
        return without_ego(torch.where(memory["wish"] != 0, memory["wish"], torch.where(comes & free, side, 0)))

    def _contested(self, scene: Scene, lane: Tensor) -> Tensor:
        """Whether a near vehicle other than the ego is already moving into ``lane`` [N, M]."""
        vehicles, pairs = scene.vehicles, scene.pairs
        target = vehicles.target_lane.to(lane.dtype)
        changing = (self.road.lane_of(vehicles.y) != target) & vehicles.valid
        changing = torch.cat((torch.zeros_like(changing[:, :1]), changing[:, 1:]), dim=1)
        near = torch.minimum(pairs.ahead, pairs.behind) < self.changes.exclusive_m
        return (near & changing[:, None, :] & (target[:, None, :] == lane[:, :, None])).any(-1)

    def rewrite(self, vehicles: Vehicles, moved: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        """Set the target lane of those whose wish finds a gap."""
        wish = self._wishes(vehicles, memory, key, step)
        scene = perceive(vehicles, self.road)
        lane = (vehicles.target_lane + wish).to(vehicles.x.dtype)
        safe = safe_change(scene, lane, self.idm, self._limits)
        wanted = torch.where(safe & ~self._contested(scene, lane), wish, 0)
        starts = one_at_a_time(scene, wanted, self.idm, self._limits)
        waited = torch.where(wish != 0, memory["waited"] + 1, 0)
        given_up = waited >= round(self.changes.patience_s / self.dt)
        rest = torch.where((starts != 0) | given_up, 0, wish)
        moved = moved.with_(target_lane=vehicles.target_lane + starts)
        return moved, {"wish": rest, "waited": torch.where(rest == 0, 0, waited)}
