"""What the agent perceives: sensor errors, Table III of the paper, and the forms of it that were
found to teach more.

:class:`SensorTransform` writes ``perceived`` next to ``vehicles``: what the ego perceives of the
others is noisy, has gaps and comes late. Observation and mask use it where it is present; physics,
reward, events and the rule-based drivers read the true ``vehicles``. Measurements not yet delivered
travel in the TensorDict as ``sensors``, so a state can be saved, branched and resumed.

=================================  ===============  ================================================
``perceived.x, y, speed, valid``   [N, M]           the scene as it was measured ``delay_s`` ago
``sensors.x, y, speed, valid``     [N, K, M]        the last K measurements, oldest first (with a
delay
                                                    of K decisions)
=================================  ===============  ================================================

Column 0 is the ego where it was when it measured, without error: what it perceives is relative to
that.

:class:`ObservationTransform` makes the observation of it. :data:`OBSERVATIONS` names the forms. A
form is a sequence of parts, each a function from a :class:`View` to [N, size].

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
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from ganlane import keys
from ganlane.errors import UserError
from ganlane.native.settings import NATIVE_FORMS
from ganlane.native.tensors import LaneView
from ganlane.settings.observation import NEARNESS_M, OVERLAP_M, ObservationScale, SensorParameters
from ganlane.sim.random import Purpose, Stream, episode_key, normal, uniform
from ganlane.sim.state import Road, Vehicles, road_in
from ganlane.torch_settings import compiled

PERCEIVED: Final = "perceived"
SENSORS: Final = "sensors"
#: Of the lane view: lane to the left, own, to the right, each ahead (+1) and behind (-1).
_SIDES = (1.0, 1.0, 0.0, 0.0, -1.0, -1.0)
_AHEAD = (1.0, -1.0, 1.0, -1.0, 1.0, -1.0)
#: Added to masked values, so that a minimum ignores them.
_MASKED = 1e9


class Measurement(NamedTuple):
    """A scene as measured by the ego's sensors, fields [N, M] or [N, K, M], the ego first; m, m/s."""

    x: Tensor
    y: Tensor
    speed: Tensor
    valid: Tensor

    @classmethod
    def of(cls, mapping: TensorDictBase) -> Measurement:
        """From a TensorDict that holds the fields."""
        return cls(*(mapping.get(name) for name in cls._fields))

    def as_tensordict(self) -> TensorDictBase:
        """The fields by name, batch [N]."""
        return TensorDict._new_unsafe(
            self._asdict(), batch_size=self.x.shape[:1], device=self.x.device
        )


def measure(
    vehicles: Vehicles, key: Tensor, step: Tensor, parameters: SensorParameters
) -> Measurement:
    """A measurement of the true ``vehicles`` [N, M] at the physics steps ``step`` [N], without the
    delay.

    ``key`` [N]: of the episodes (:func:`ganlane.sim.random.episode_key`).
    """
    x, y, speed, valid = vehicles.x, vehicles.y, vehicles.speed, vehicles.valid
    scales = (parameters.position_noise_m, parameters.lateral_noise_m, parameters.speed_noise_mps)
    count = x.shape[1]
    other = torch.arange(count, device=x.device) != keys.EGO_INDEX
    if any(scales):
        purposes: list[int] = [
            Purpose.SENSED_POSITION,
            Purpose.SENSED_LATERAL,
            Purpose.SENSED_SPEED,
        ]
        noise = normal(key, step, count, purposes, x.dtype)
        x, y, speed = (
            torch.where(other, value + scale * noise[..., i], value)
            for i, (value, scale) in enumerate(zip((x, y, speed), scales))
        )
    if parameters.dropout > 0:
        lost = (
            uniform(key, step, count, [Purpose.SENSED_DROPOUT], x.dtype)[..., 0]
            < parameters.dropout
        )
        valid = valid & ~(lost & other)
    return Measurement(x, y, speed, valid)


class PerceptionTransform(Transform):
    """Base of the transforms that read what the ego perceives: subclasses implement :meth:`write`."""

    def write(self, state: TensorDictBase, vehicles: Vehicles, seen: Vehicles) -> TensorDictBase:
        """Write the out keys into ``state``.

        ``vehicles`` are true, ``seen`` as the ego perceives them.
        """
        raise NotImplementedError

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the out keys into any TensorDict that holds the raw state."""
        vehicles, perceived = (
            Vehicles.of(tensordict.get(keys.VEHICLES)),
            tensordict.get(PERCEIVED, None),
        )
        seen = (
            vehicles if perceived is None else vehicles.with_(**Measurement.of(perceived)._asdict())
        )
        return self.write(tensordict, vehicles, seen)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self.forward(tensordict_reset)


class SensorTransform(Transform):
    """Write ``perceived``, and with a delay ``sensors``; belongs before the
    :class:`ObservationTransform`.

    The errors follow from (stream, seed, episode, vehicle, physics step, purpose), so an episode is
    the same in any batch and when it is replayed. The ego measures once per decision, at its end;
    until the first measurement of an episode is old enough, that one is delivered.

    Args:
        parameters: sizes of the errors; None: none.
        stream, decision_period_s: the environment's.

    Raises:
        UserError: the delay is not a multiple of the decision period; in a step, if the state comes
            from an environment without this delay.
    """

    def __init__(
        self,
        parameters: SensorParameters | None = None,
        stream: int = Stream.TRAIN,
        decision_period_s: float = 1.0,
    ) -> None:
        in_keys = [keys.VEHICLES, keys.SEED, keys.EPISODE, keys.STEP]
        super().__init__(in_keys=in_keys, out_keys=[PERCEIVED])
        self.parameters = parameters or SensorParameters()
        self.stream = int(stream)
        self.delay = self.parameters.delay_decisions(decision_period_s)

    def measured(self, state: TensorDictBase) -> Measurement:
        """The measurement of the true state in ``state``, fields [N, M]."""
        key = episode_key(self.stream, state.get(keys.SEED), state.get(keys.EPISODE))
        return measure(
            Vehicles.of(state.get(keys.VEHICLES)), key, state.get(keys.STEP), self.parameters
        )

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        new = self.measured(next_tensordict)
        if self.delay == 0:
            return next_tensordict.set(PERCEIVED, new.as_tensordict())
        held = tensordict.get(SENSORS, None)
        if held is None or held.get("x").shape[1] != self.delay:
            raise UserError(
                f"the state holds no {self.delay} measurements under {SENSORS!r}: it comes from an environment with "
                "other sensors; start from a reset of this one."
            )
        kept = Measurement.of(held)
        moved = (torch.cat((old[:, 1:], fresh[:, None]), dim=1) for old, fresh in zip(kept, new))
        next_tensordict.set(SENSORS, Measurement(*moved).as_tensordict())
        oldest = Measurement(*(old[:, 0].clone() for old in kept))
        return next_tensordict.set(PERCEIVED, oldest.as_tensordict())

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        first = self.measured(tensordict_reset)
        if self.delay > 0:
            filled = (field[:, None].repeat(1, self.delay, 1) for field in first)
            tensordict_reset.set(SENSORS, Measurement(*filled).as_tensordict())
        return tensordict_reset.set(PERCEIVED, first.as_tensordict())

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write what the ego would perceive if the raw state in ``tensordict`` were an episode's
        first.
        """
        return self._reset(tensordict, tensordict)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add ``perceived``, and with a delay ``sensors``, to the spec."""
        assert isinstance(observation_spec, Composite)
        true = observation_spec[keys.VEHICLES, "x"]
        rows, count = true.shape
        for name, shape in ((PERCEIVED, (rows, count)), (SENSORS, (rows, self.delay, count))):
            if name == PERCEIVED or self.delay > 0:
                fields = {
                    each: Unbounded(shape=shape, dtype=true.dtype) for each in ("x", "y", "speed")
                }
                fields["valid"] = Binary(shape=shape, dtype=torch.bool)
                observation_spec[name] = Composite(fields, shape=shape[:1]).to(true.device)
        return observation_spec


class Others(NamedTuple):
    """The other vehicles relative to the ego, each [N, M - 1]; the first three are clipped to [-1,
    1].

    Table III: relative position, relative speed, lane difference (left is positive), and whether
    the vehicle exists. Not in Table III: ``drift``, the position within its lane (0 in the centre,
    1 on the left line, -1 on the right one), and ``bumpers_m``, half of the ego's length plus half
    of its own, m.
    """

    position: Tensor
    speed: Tensor
    lane: Tensor
    valid: Tensor
    drift: Tensor
    bumpers_m: Tensor


class View(NamedTuple):
    """What the parts of an observation are computed from.

    ``vehicles`` is the true state; ``seen`` the others as the ego perceives them, with the ego
    (column 0) where it was at that moment. ``progress`` and ``direction`` [N] belong to the ego's
    own lane change.
    """

    vehicles: Vehicles
    seen: Vehicles
    others: Others
    road: Road
    scale: ObservationScale
    progress: Tensor
    direction: Tensor


def other_vehicles(vehicles: Vehicles, road: Road, scale: ObservationScale) -> Others:
    """The others, ordered by the vehicles' indices; an invalid one is (1, 0, 0), far ahead."""
    ego, others = vehicles.columns(slice(0, 1)), vehicles.columns(slice(1, None))
    position = (road.distance_ahead(ego.x, others.x) / scale.range_m).clamp(-1.0, 1.0)
    speed = ((others.speed - ego.speed) / scale.speed_mps).clamp(-1.0, 1.0)
    own_lane = road.lane_of(others.y)
    lane = ((own_lane - road.lane_of(ego.y)) / _widest(road.lanes)).clamp(-1.0, 1.0)
    # Offset to the left of the lane's centre over half of the lane's width.
    drift = (2.0 * (others.y - road.centre_of(own_lane, others.y.dtype)) / road.lane_width_m).clamp(
        -1.0, 1.0
    )
    bumpers_m, valid = 0.5 * ego.length + 0.5 * others.length, others.valid
    speed, lane, drift, bumpers_m = (
        torch.where(valid, each, 0.0) for each in (speed, lane, drift, bumpers_m)
    )
    return Others(torch.where(valid, position, 1.0), speed, lane, valid, drift, bumpers_m)


def _widest(lanes: int | Tensor) -> int | Tensor:
    """The largest lane difference, at least 1."""
    return (lanes - 1).clamp_min(1) if isinstance(lanes, Tensor) else max(lanes - 1, 1)


def own_state(view: View) -> Tensor:
    """s1 to s3, [N, 3].

    Speed over desired speed (not clipped), a lane to the left, a lane to the right.
    """
    ego, road = view.vehicles.columns(slice(0, 1)), view.road
    lane = road.lane_of(ego.y)
    beside = (lane < road.lanes - 1, lane > 0)
    return torch.cat(
        (ego.speed / ego.desired_speed, *(there.to(ego.y.dtype) for there in beside)), dim=1
    )


def vehicle_list(view: View) -> Tensor:
    """s4, s5, s6, s7, ..., [N, 3 (M - 1)].

    Position, speed and lane of each vehicle, nearest first, invalid last.
    """
    distance = view.road.distance_ahead(view.seen.x[:, :1], view.seen.x[:, 1:]).abs()
    order = torch.where(view.others.valid, distance, torch.inf).argsort(dim=1, stable=True)
    return torch.stack([field.gather(1, order) for field in view.others[:3]], dim=-1).flatten(1)


def lane_view(view: View, drift: bool = False, overlap: bool = False) -> Tensor:
    """[N, 18]: left, own and right lane x ahead and behind x (gap, nearness, relative speed); (1,
    0, 0) if empty.

    The nearest vehicle is the one with the nearest centre; one exactly level with the ego counts as
    behind. The gap, over the range of sight, is from bumper to bumper.

    ``drift`` adds a fourth number, :attr:`Others.drift`, [N, 24], which shows a lane change before
    its middle. With ``overlap``, where two bodies overlap along the road the gap is below 0, and
    the nearness above 1 by 1 per metre; otherwise the gap is 0 there.
    """
    others, range_m = view.others, view.scale.range_m
    side, ahead = (others.position.new_tensor(each)[:, None] for each in (_SIDES, _AHEAD))
    distance = others.position[:, None, :] * ahead
    in_sight = (others.valid & (others.position.abs() < 1.0))[:, None, :]
    on_that_end = (distance > 0) | ((distance == 0) & (ahead < 0))
    lanes_apart = torch.round(others.lane * _widest(view.road.lanes))[:, None, :]
    distance = torch.add(distance, ~(in_sight & on_that_end & (lanes_apart == side)), alpha=_MASKED)
    nearest = distance.amin(-1, keepdim=True)
    farther, found = distance > nearest, nearest <= 1.0

    def of_the_nearest(field: Tensor) -> Tensor:
        value = torch.add(field[:, None, :], farther, alpha=_MASKED).amin(-1, keepdim=True)
        return torch.where(found, value, 0.0)

    # Of two equally near vehicles the longer one counts.
    gap_m = nearest * range_m + of_the_nearest(-others.bumpers_m)
    gap_m = gap_m if overlap else gap_m.clamp_min(0.0)
    gap = torch.where(found, gap_m / range_m, 1.0)
    overlap_m = (-gap_m).clamp_min(0.0)
    nearness = torch.where(
        found, torch.exp(-gap_m.clamp_min(0.0) / NEARNESS_M) + overlap_m / OVERLAP_M, 0.0
    )
    numbers = (
        gap,
        nearness,
        of_the_nearest(others.speed),
        *((of_the_nearest(others.drift),) if drift else ()),
    )
    return torch.cat(numbers, dim=-1).flatten(1)


def lane_change(view: View) -> Tensor:
    """The ego's own lane change, [N, 2]: progress 0 to 1, direction -1, 0 or 1."""
    return torch.stack((view.progress, view.direction.to(view.progress.dtype)), dim=1)


class Part(NamedTuple):
    """A part of an observation: its size for a number of other vehicles, and its numbers [N, size]."""

    size: Callable[[int], int]
    numbers: Callable[[View], Tensor]


OWN = Part(lambda others: 3, own_state)
LIST = Part(lambda others: 3 * others, vehicle_list)
VIEW = Part(lambda others: 18, lane_view)
DRIFT_VIEW = Part(lambda others: 24, partial(lane_view, drift=True))
OVERLAP_VIEW = Part(lambda others: 24, partial(lane_view, drift=True, overlap=True))
CHANGE = Part(lambda others: 2, lane_change)

#: The forms by name; ``table3`` is the paper's literal 3 + 3 (M - 1) numbers.
OBSERVATIONS: Final[dict[str, tuple[Part, ...]]] = {
    "table3": (OWN, LIST),
    "table3_progress": (OWN, LIST, CHANGE),
    "lane_view": (OWN, VIEW, CHANGE),
    "table3_lane_view": (OWN, LIST, VIEW, CHANGE),
    "lane_view_drift": (OWN, DRIFT_VIEW, CHANGE),
    "lane_view_overlap": (OWN, OVERLAP_VIEW, CHANGE),
}


def observation_size(name: str, vehicles: int) -> int:
    """Length D of observation ``name`` for ``vehicles`` vehicles, the ego included."""
    return sum(part.size(vehicles - 1) for part in OBSERVATIONS[name])


class ObservationTransform(PerceptionTransform):
    """Write ``observation`` [N, D] from the raw state, the others as ``perceived`` where that is
    present.

    Args:
        road, vehicles: the environment's; M, the ego included.
        form: a key of :data:`OBSERVATIONS`.
        scale: normalisers.
        native: the native kernel computes the forms in ``NATIVE_FORMS``, for float32 on a CPU.

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
    ) -> None:
        super().__init__(in_keys=[keys.VEHICLES, keys.EGO], out_keys=[keys.OBSERVATION])
        if form not in OBSERVATIONS:
            raise UserError(
                f"observation.form={form!r} is unknown; choose one of {', '.join(OBSERVATIONS)}."
            )
        if vehicles < 2:
            raise UserError(
                f"vehicles={vehicles}: an observation is of at least one other vehicle; give 2 or more."
            )
        self.road, self.vehicles, self.form = road, vehicles, form
        self.scale = scale or ObservationScale()
        self.native: LaneView | None = None
        if native and form in NATIVE_FORMS:
            self.native = LaneView(road, vehicles, self.scale, form)

    def observe(
        self,
        vehicles: Vehicles,
        progress: Tensor,
        direction: Tensor,
        road: Road,
        seen: Vehicles | None = None,
    ) -> Tensor:
        """The observation [N, D]; arguments as the fields of :class:`View`, ``seen=None``.

        As they are.
        """
        seen = vehicles if seen is None else seen
        others = other_vehicles(seen, road, self.scale)
        view = View(vehicles, seen, others, road, self.scale, progress, direction)
        return torch.cat([part.numbers(view) for part in OBSERVATIONS[self.form]], dim=1)

    def compile_graphs(self) -> None:
        """Compile the observation to one graph (``env.compile=true``)."""
        self.observe = compiled(self.observe)  # type: ignore[method-assign]

    def write(self, state: TensorDictBase, vehicles: Vehicles, seen: Vehicles) -> TensorDictBase:
        """Write ``observation``."""
        ego, road = state.get(keys.EGO), road_in(state, self.road)
        progress, direction = ego.get("change_progress"), ego.get("change_direction")
        if self.native is not None:
            return state.set(
                keys.OBSERVATION, self.native.observe(vehicles, progress, direction, seen)
            )
        return state.set(keys.OBSERVATION, self.observe(vehicles, progress, direction, road, seen))

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add ``observation`` to the spec."""
        assert isinstance(observation_spec, Composite)
        shape = (*observation_spec.shape, observation_size(self.form, self.vehicles))
        dtype = observation_spec[keys.VEHICLES, "x"].dtype
        observation_spec[keys.OBSERVATION] = Unbounded(
            shape=shape, dtype=dtype, device=observation_spec.device
        )
        return observation_spec
