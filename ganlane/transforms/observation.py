"""Table III of the paper, and the forms of it that were found to teach more.

:class:`ObservationTransform` makes the observation of what the ego perceives. :data:`OBSERVATIONS`
names the forms. A form is a sequence of parts, each a function from a :class:`View` to [N, size].

Lane view: for the left, own and right lane the nearest vehicle ahead and behind, each with gap,
``exp(-gap / 15 m)`` and relative speed. A small network learns the advantages of a lane change from
it, but not from the list of vehicles, nearest first: the order of that list changes whenever two
vehicles swap ranks.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.errors import UserError
from ganlane.native.settings import CONTROL_NUMBERS, HEADING_RAD, NATIVE_FORMS
from ganlane.native.tensors import LaneView, wants_gradient
from ganlane.settings.actions import LANE_SPEED, ActionParameters
from ganlane.settings.observation import NEARNESS_M, OVERLAP_M, ROAD_SIGHT_M, ObservationScale
from ganlane.sim.lane_ends import begins, ends, may_change, of_lane, on_road
from ganlane.sim.state import Road, Vehicles, road_in
from ganlane.torch_settings import constant
from ganlane.transforms.sensors import PerceptionTransform

#: Of the lane view: lane to the left, own, to the right, each ahead (+1) and behind (-1).
_SIDES = (1.0, 1.0, 0.0, 0.0, -1.0, -1.0)
_AHEAD = (1.0, -1.0, 1.0, -1.0, 1.0, -1.0)
#: Added to masked values, so that a minimum ignores them.
_MASKED = 1e9


class Others(NamedTuple):
    """The other vehicles relative to the ego, each [N, M - 1].

    The first three are Table III's numbers, scaled and clipped to [-1, 1].

    Attributes:
        position: distance along the road, ahead of the ego positive.
        speed: relative speed, positive if faster than the ego.
        lane: lanes apart, to the left positive.
        valid: whether the vehicle exists, bool.
        drift: position within its lane: 0 in the centre, 1 on the left line, -1 on the right one.
        bumpers_m: half of the ego's length plus half of its own, m.
    """

    position: Tensor
    speed: Tensor
    lane: Tensor
    valid: Tensor
    drift: Tensor
    bumpers_m: Tensor


class View(NamedTuple):
    """What the parts of an observation are computed from.

    Attributes:
        vehicles: the true state, [N, M].
        seen: the others as the ego perceives them, [N, M], with the ego (column 0) where it was at
            that moment.
        others: ``seen`` relative to the ego.
        road: the environment's, or of each row.
        scale: normalisers.
        progress: of the ego's own lane change, 0 to 1, [N].
        direction: of that change, -1 right, 0 none, 1 left, [N].
    """

    vehicles: Vehicles
    seen: Vehicles
    others: Others
    road: Road
    scale: ObservationScale
    progress: Tensor
    direction: Tensor


def other_vehicles(vehicles: Vehicles, road: Road, scale: ObservationScale) -> Others:
    """The others, ordered by the vehicles' indices; an invalid one is (1, 0, 0), far ahead.

    ``vehicles`` [N, M] are as the ego perceives them.
    """
    ego = vehicles.columns(slice(0, 1))
    others = vehicles.columns(slice(1, None))

    # Relative numbers over their scale, clipped.
    distance = road.distance_ahead(ego.x, others.x)
    position = (distance / scale.range_m).clamp(-1.0, 1.0)
    speed = ((others.speed - ego.speed) / scale.speed_mps).clamp(-1.0, 1.0)
    own_lane = road.lane_of(others.y)
    lanes_apart = own_lane - road.lane_of(ego.y)
    lane = (lanes_apart / _widest(road.lanes)).clamp(-1.0, 1.0)

    # Offset to the left of the lane's centre over half of the lane's width.
    offset = others.y - road.centre_of(own_lane, others.y.dtype)
    drift = (2.0 * offset / road.lane_width_m).clamp(-1.0, 1.0)
    bumpers_m = 0.5 * ego.length + 0.5 * others.length

    valid = others.valid
    return Others(
        position=torch.where(valid, position, 1.0),
        speed=torch.where(valid, speed, 0.0),
        lane=torch.where(valid, lane, 0.0),
        valid=valid,
        drift=torch.where(valid, drift, 0.0),
        bumpers_m=torch.where(valid, bumpers_m, 0.0),
    )


def _widest(lanes: int | Tensor) -> int | Tensor:
    """The largest lane difference, at least 1."""
    if isinstance(lanes, Tensor):
        return (lanes - 1).clamp_min(1)
    return max(lanes - 1, 1)


def own_state(view: View, here: bool = False) -> Tensor:
    """s1 to s3, [N, 3].

    Speed over desired speed (not clipped), then whether there is a lane to the left and to the
    right, 0 or 1.

    Args:
        here: a lane counts only where the ego may change into it; else anywhere on the road.
    """
    ego = view.vehicles.columns(slice(0, 1))
    road = view.road
    lane = road.lane_of(ego.y)
    sides = constant((1.0, -1.0), lane)

    # Whether there is a lane to change to, [N, 2].
    there = may_change(road, lane, sides, ego.x) if here else on_road(road, lane + sides)

    return torch.cat((ego.speed / ego.desired_speed, there.to(ego.y.dtype)), dim=1)


def vehicle_list(view: View) -> Tensor:
    """s4, s5, s6, s7, ..., [N, 3 (M - 1)].

    Position, speed and lane of each vehicle, nearest first, invalid last.
    """
    # Sorted by distance, not by the clipped position, which is alike for all far ones.
    x = view.seen.x
    distance = view.road.distance_ahead(x[:, :1], x[:, 1:]).abs()
    distance = torch.where(view.others.valid, distance, torch.inf)
    order = distance.argsort(dim=1, stable=True)

    # Position, speed and lane of one vehicle after the other.
    columns = [field.gather(1, order) for field in view.others[:3]]
    return torch.stack(columns, dim=-1).flatten(1)


def lane_view(view: View, drift: bool = False, overlap: bool = False) -> Tensor:
    """The nearest vehicle in each lane and direction, [N, 18].

    Left, own and right lane x ahead and behind x (gap, nearness, relative speed); (1, 0, 0) if
    there is none. The nearest vehicle is the one with the nearest centre; one exactly level with
    the ego counts as behind. The gap, over the range of sight, is from bumper to bumper.

    Args:
        drift: adds a fourth number, :attr:`Others.drift`, [N, 24], which shows a lane change before
            its middle.
        overlap: where two bodies overlap along the road the gap is below 0, and the nearness above
            1 by 1 per metre; without it the gap is 0 there.
    """
    others = view.others
    range_m = view.scale.range_m

    # All six directions at once: each is a minimum over the vehicles there.
    side = constant(_SIDES, others.position)[:, None]
    ahead = constant(_AHEAD, others.position)[:, None]

    # Distances [N, 6, M - 1] in the six directions, out of reach for who is not there.
    distance = others.position[:, None, :] * ahead

    # At the range of sight the position is clipped to 1.
    in_sight = (others.valid & (others.position.abs() < 1.0))[:, None, :]
    on_that_end = (distance > 0) | ((distance == 0) & (ahead < 0))
    # Back to whole lanes from what was scaled in other_vehicles().
    lanes_apart = torch.round(others.lane * _widest(view.road.lanes))[:, None, :]
    absent = ~(in_sight & on_that_end & (lanes_apart == side))
    distance = torch.add(distance, absent, alpha=_MASKED)

    # [N, 6, 1]
    nearest = distance.amin(-1, keepdim=True)
    # Several vehicles can be equally near: the minimum over all of them is taken below.
    farther = distance > nearest
    exists = nearest <= 1.0

    def of_the_nearest(field: Tensor) -> Tensor:
        """A ``field`` [N, M - 1] of the nearest vehicle, [N, 6, 1]; the lowest if equally near."""
        value = torch.add(field[:, None, :], farther, alpha=_MASKED)
        return torch.where(exists, value.amin(-1, keepdim=True), 0.0)

    # Of two equally near vehicles the longer one counts.
    gap_m = nearest * range_m + of_the_nearest(-others.bumpers_m)
    if not overlap:
        gap_m = gap_m.clamp_min(0.0)
    overlap_m = (-gap_m).clamp_min(0.0)
    nearness = torch.exp(-gap_m.clamp_min(0.0) / NEARNESS_M) + overlap_m / OVERLAP_M

    numbers = [
        torch.where(exists, gap_m / range_m, 1.0),
        torch.where(exists, nearness, 0.0),
        of_the_nearest(others.speed),
    ]
    if drift:
        numbers.append(of_the_nearest(others.drift))
    return torch.cat(numbers, dim=-1).flatten(1)


def lane_change(view: View) -> Tensor:
    """The ego's own lane change, [N, 2]: progress 0 to 1, direction -1, 0 or 1."""
    return torch.stack((view.progress, view.direction.to(view.progress.dtype)), dim=1)


def road_ahead(view: View) -> Tensor:
    """Where lanes begin and end, [N, 8]; distances over :data:`ROAD_SIGHT_M`, from 0 to 1.

    Of the left, own and right lane how far it goes on, [N, 3], and how far away it begins, [N, 3]:
    0 and 1 for a lane that the road has not. Then the lanes between the ego and the exit lane over
    ``max(n - 1, 1)``, positive to the left, and the distance of its end: (0, 1) without an exit.
    """
    ego = view.vehicles.columns(slice(0, 1))
    road = view.road
    front = ego.x + 0.5 * ego.length
    lane = road.lane_of(ego.y)

    # Left, own and right lane, [N, 3].
    lanes = lane + constant((1.0, 0.0, -1.0), lane)
    there = on_road(road, lanes)

    # A road whose lanes all go on, without an exit.
    far = torch.ones_like(lanes)
    goes_on = far
    begins_in = far - 1.0
    ahead = lane - lane
    distance = far[:, :1]

    if road.has_lane_ends:
        goes_on = _in_sight(of_lane(ends(road), lanes, front) - front)
        begins_in = _in_sight(of_lane(begins(road), lanes, front) - front)
    if road.exit_lane is not None:
        ahead = (road.exit_lane - lane) / _widest(road.lanes)
        distance = _in_sight(ends(road)[road.exit_lane] - front)

    goes_on = torch.where(there, goes_on, 0.0)
    begins_in = torch.where(there, begins_in, 1.0)
    return torch.cat((goes_on, begins_in, ahead, distance), dim=1)


def _in_sight(distance_m: Tensor) -> Tensor:
    """A distance over the range of sight, from 0 to 1."""
    return (distance_m / ROAD_SIGHT_M).clamp(0.0, 1.0)


class Part(NamedTuple):
    """A part of an observation.

    Attributes:
        numbers: computes it, [N, size], or [N, size (M - 1)].
        size: how many numbers it has, in all or of every other vehicle.
        each_vehicle: whether ``size`` is that of every other vehicle.
    """

    numbers: Callable[[View], Tensor]
    size: int
    each_vehicle: bool = False


OWN = Part(own_state, 3)
OWN_HERE = Part(partial(own_state, here=True), 3)
LIST = Part(vehicle_list, 3, each_vehicle=True)
VIEW = Part(lane_view, 18)
DRIFT_VIEW = Part(partial(lane_view, drift=True), 24)
OVERLAP_VIEW = Part(partial(lane_view, drift=True, overlap=True), 24)
CHANGE = Part(lane_change, 2)
ROAD = Part(road_ahead, 8)

#: The forms by name; ``table3`` is the paper's literal 3 + 3 (M - 1) numbers.
OBSERVATIONS: Final[dict[str, tuple[Part, ...]]] = {
    "table3": (OWN, LIST),
    "table3_progress": (OWN, LIST, CHANGE),
    "lane_view": (OWN, VIEW, CHANGE),
    "table3_lane_view": (OWN, LIST, VIEW, CHANGE),
    "lane_view_drift": (OWN, DRIFT_VIEW, CHANGE),
    "lane_view_overlap": (OWN, OVERLAP_VIEW, CHANGE),
    "road_view": (OWN_HERE, OVERLAP_VIEW, CHANGE, ROAD),
}


def control_numbers(vehicles: Vehicles, set_speed: Tensor | None, road: Road) -> Tensor:
    """What the driver needs to command more than the lane.

    Args:
        set_speed: of ``lane_speed``, [N], m/s; None: the actions are ``continuous``.

    Returns:
        For ``lane_speed`` the set speed over the desired speed, [N, 1]. For ``continuous`` the
        ego's offset in its lane (1 on the left line, -1 on the right one) and its heading over
        ``HEADING_RAD``, to the left positive, clipped to [-1, 1], [N, 2].
    """
    ego = vehicles.columns(slice(0, 1))
    if set_speed is not None:
        return set_speed[:, None] / ego.desired_speed

    centre = road.centre_of(road.lane_of(ego.y), ego.y.dtype)
    offset = 2.0 * (ego.y - centre) / road.lane_width_m
    return torch.cat((offset, ego.heading / HEADING_RAD), dim=1).clamp(-1.0, 1.0)


def observation_size(name: str, vehicles: int, actions: ActionParameters | None = None) -> int:
    """Length D of observation ``name``.

    Args:
        name: a key of :data:`OBSERVATIONS`.
        vehicles: M, the ego included.
        actions: those of the environment; None: numbered lane changes.
    """
    size = 0
    if actions is not None:
        size = CONTROL_NUMBERS[actions.form]
    for part in OBSERVATIONS[name]:
        times = vehicles - 1 if part.each_vehicle else 1
        size += part.size * times
    return size


class ObservationTransform(PerceptionTransform):
    """Write ``observation`` [N, D] from the raw state, the others as ``perceived`` where that is
    present.

    Args:
        road, vehicles: the environment's; M, the ego included.
        form: a key of :data:`OBSERVATIONS`.
        scale: normalisers.
        native: the native kernel computes the forms in ``NATIVE_FORMS``, for float32 on a CPU.
        actions: those of the environment; :func:`control_numbers` are at the end for some.

    Raises:
        UserError: an unknown form, or fewer than two vehicles.
    """

    def __init__(
        self,
        road: Road,
        vehicles: int = 9,
        form: str = "table3_progress",
        scale: ObservationScale | None = None,
        native: bool = False,
        actions: ActionParameters | None = None,
    ) -> None:
        super().__init__(in_keys=[keys.VEHICLES, keys.EGO], out_keys=[keys.OBSERVATION])
        if form not in OBSERVATIONS:
            raise UserError(
                f"observation.form={form!r} is unknown; choose one of {', '.join(OBSERVATIONS)}."
            )
        if vehicles < 2:
            raise UserError(
                f"vehicles={vehicles}: an observation is of at least one other vehicle; "
                "give 2 or more."
            )

        self.road = road
        self.vehicles = vehicles
        self.form = form
        self.actions = actions or ActionParameters()
        self.scale = scale or ObservationScale()

        #: The kernel's function; None: the tensor code computes the observation.
        self.native: LaneView | None = None
        if native and form in NATIVE_FORMS:
            self.native = LaneView(road, vehicles, self.scale, form)

    def observe(
        self,
        vehicles: Vehicles,
        progress: Tensor,
        direction: Tensor,
        road: Road,
        seen: Vehicles,
    ) -> Tensor:
        """The observation [N, D]; arguments as the fields of :class:`View`."""
        others = other_vehicles(seen, road, self.scale)
        view = View(vehicles, seen, others, road, self.scale, progress, direction)
        parts = [part.numbers(view) for part in OBSERVATIONS[self.form]]
        return torch.cat(parts, dim=1)

    def write(self, state: TensorDictBase, vehicles: Vehicles, seen: Vehicles) -> TensorDictBase:
        """Write ``observation``."""
        # Own state from the truth, the others as perceived.
        ego = state.get(keys.EGO)
        progress = ego.get("change_progress")
        direction = ego.get("change_direction")
        road = road_in(state, self.road)

        # The kernel computes the same numbers up to the rounding of the exponential function.
        if self.native is not None and not wants_gradient([*vehicles, *seen, progress]):
            observation = self.native.observe(vehicles, progress, direction, seen)
        else:
            observation = self.observe(vehicles, progress, direction, road, seen)

        # Some actions need further numbers.
        if CONTROL_NUMBERS[self.actions.form]:
            set_speed = ego.get(keys.SET_SPEED) if self.actions.form == LANE_SPEED else None
            further = control_numbers(vehicles, set_speed, road)
            observation = torch.cat((observation, further), dim=1)
        return state.set(keys.OBSERVATION, observation)
