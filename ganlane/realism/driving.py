"""Recorded scenes driven by a traffic: the same vehicles and road, for as long as recorded; and
reference drivers.

A vehicle is driven from the frame at which it was first recorded to the one at which it was last
recorded, or until it passes the end of the recorded road. One that appears later waits while
another occupies its place, and enters in its recorded state at the first frame in which there is
room. So simulation and recording hold the same drivers at the same times, whatever the model does.
Index 0, the ego's, is not valid.

Others perceive a vehicle in the lane of its centre (and in its target lane, if it signals):
recorded lanes are narrow and straightened to some decimetres, so by their bodies one vehicle in ten
would occupy two lanes.

Headways: a driver recorded behind a leader has shown how closely it follows. With a headway drawn
at random half of the drivers would begin with hard braking, and the first seconds would measure
nothing else. So a traffic with a headway per driver (a memory ``headway`` [N, M] in s) starts with
those that balance the recorded gaps. Traffic with one headway for everybody (IDM, Table V) keeps
it.

Two drivers mark the ends of the scale (random driving, constant velocity); :class:`HeadwayIdm` is a
control.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.generator.closed_loop import balanced_headway, headway_from_uniform
from ganlane.realism.recordings import Recording, frame_of
from ganlane.sim.idm import following_acceleration
from ganlane.sim.neighbours import perceive
from ganlane.sim.random import Purpose, absorb, episode_key, uniform
from ganlane.sim.state import ENTRY_M, Road, Vehicles
from ganlane.traffic.base import TrafficModule
from ganlane.traffic.overlays import random_side

#: Makes a traffic model for a road.
Factory = Callable[[Road], TrafficModule]
#: A vehicle enters only where the gaps to those ahead and behind in its lane are at least this, m.
ENTRY_GAP_M = 2.0
#: Desired speeds are kept within these bounds, m/s.
SLOWEST_DESIRED_MPS, FASTEST_DESIRED_MPS = 5.0, 35.0
#: Rows times vehicles times vehicles simulated at once; bounds the memory.
_MOST_PAIRS = 1_000_000
#: Position of absent vehicles, m.
_ABSENT_M = -10_000.0
#: Tolerance of positions, m.
_ROUNDING_M = 0.01


@dataclass(frozen=True)
class StartOptions:
    """How recorded scenes are driven.

    Attributes:
        desired_above_mps: desired speeds are the speed at entry and a uniform number from 0 on with
            this mean.
        repeats: times that every scene is driven, with different random numbers.
    """

    desired_above_mps: float = 6.0
    repeats: int = 1
    seed: int = 0


def drive_recordings(
    make: Factory, recordings: Sequence[Recording], options: StartOptions
) -> pl.DataFrame:
    """Drive every recording ``options.repeats`` times, those on equal roads side by side.

    See :func:`frame_of`.
    """
    roads: dict[tuple[int, float], list[Recording]] = {}
    for each in recordings:
        roads.setdefault((each.lanes, each.lane_width_m), []).append(each)
    frames: list[pl.DataFrame] = []
    for road, group in roads.items():
        for rows in _batches([each for each in group for _ in range(options.repeats)]):
            frames += _drive(make(Road(*road)), rows, options, first=len(frames))
    return pl.concat(frames)


def _batches(rows: list[Recording]) -> list[list[Recording]]:
    """Rows of similar lengths together, at most :data:`_MOST_PAIRS` pairs of vehicles in a batch."""
    ordered = sorted(rows, key=lambda each: (len(each.x), len(each.length)))
    batches: list[list[Recording]] = []
    for row in ordered:
        most = max(len(each.length) for each in [row, *(batches[-1] if batches else [])])
        if batches and (len(batches[-1]) + 1) * most * most <= _MOST_PAIRS:
            batches[-1].append(row)
        else:
            batches.append([row])
    return batches


def _drive(
    traffic: TrafficModule, rows: list[Recording], options: StartOptions, first: int
) -> list[pl.DataFrame]:
    """Drives a batch of recordings on one road; one frame per row."""
    batch, n = RecordingBatch.of(rows), len(rows)
    counters = {keys.SEED: torch.full((n,), options.seed), keys.EPISODE: first + torch.arange(n)}
    key = episode_key(traffic.stream, *counters.values())
    u = uniform(key, 0, batch.x.shape[2], [Purpose.SPAWN_DESIRED_SPEED])[..., 0]
    excess = 2.0 * options.desired_above_mps * u
    state = no_vehicles(batch, traffic)
    memory: TensorDictBase | None = None
    course: dict[str, list[Tensor]] = {name: [] for name in ("x", "y", "valid")}
    waiting = torch.ones_like(batch.present[0])
    for step in range(len(batch.x)):
        state = remove_finished(batch, state, step)
        entering = may_enter(batch, state, waiting, traffic.road, step)
        waiting = waiting & ~entering
        state = insert_entering(batch, state, entering, excess, traffic, step)
        memory = _updated_memory(traffic, state, memory, entering, absorb(key, 0))
        for name, values in course.items():
            values.append(getattr(state, name)[:, 1:])
        state, memory = step_traffic(traffic, state, memory, counters, step)
    arrays = [torch.stack(values).numpy() for values in course.values()]
    frames = []
    for index, row in enumerate(rows):
        steps, vehicles = row.x.shape
        x, y, valid = (array[:steps, index, :vehicles] for array in arrays)
        frames.append(frame_of(row, x, y, valid, f"{row.name}#{first + index}"))
    return frames


def step_traffic(
    traffic: TrafficModule,
    state: Vehicles,
    memory: TensorDictBase,
    counters: dict[str, Tensor],
    step: int,
) -> tuple[Vehicles, TensorDictBase]:
    """State and memory at t + 0.1 s when the traffic drives without an ego.

    Invalid vehicles stay as they are.
    """
    size = torch.Size([state.x.shape[0]])
    view = TensorDict._new_unsafe(
        {
            keys.VEHICLES: TensorDict._new_unsafe(state.as_dict(), batch_size=size),
            keys.TRAFFIC: memory,
            **counters,
            keys.STEP: torch.full(size, step),
        },
        batch_size=size,
    )
    traffic(view)
    return Vehicles.of(view.get(keys.MOVED)).where(state.valid, state), view.get(keys.TRAFFIC)


def _updated_memory(
    traffic: TrafficModule,
    state: Vehicles,
    memory: TensorDictBase | None,
    enters: Tensor,
    key: Tensor,
) -> TensorDictBase:
    """The traffic's memory, initialised for the vehicles that enter, with their recorded headways."""
    if memory is not None and not bool(enters.any()):
        return memory
    fresh = with_recorded_headways(traffic.init_memory(state, key), state, traffic.road, enters)

    def merged(new: Tensor, old: Tensor) -> Tensor:
        return torch.where(enters.reshape(*enters.shape, *[1] * (new.ndim - 2)), new, old)

    return fresh if memory is None else fresh.apply(merged, memory)


@dataclass(frozen=True)
class RecordingBatch:
    """Recordings side by side, padded with absent vehicles; index 0 is the ego's and absent.

    ``x``, ``y``, ``speed`` and ``present`` are [T, N, M], ``length`` and ``driven`` [N, M];
    ``end_m`` [N, 1] is where each road ends, m.
    """

    x: Tensor
    y: Tensor
    speed: Tensor
    present: Tensor
    length: Tensor
    driven: Tensor
    end_m: Tensor

    @classmethod
    def of(cls, rows: Sequence[Recording]) -> RecordingBatch:
        """Pads and stacks recordings."""
        steps, most = max(len(row.x) for row in rows), max(len(row.length) for row in rows)

        def padded(name: str) -> Tensor:
            values = [getattr(row, name) for row in rows]
            whole = np.zeros(
                (*([steps] if values[0].ndim == 2 else []), len(rows), most + 1),
                dtype=values[0].dtype,
            )
            for index, value in enumerate(values):
                where = (slice(len(value)), index) if value.ndim == 2 else (index,)
                whole[(*where, slice(1, value.shape[-1] + 1))] = value
            tensor = torch.from_numpy(whole)
            return tensor.float() if tensor.is_floating_point() else tensor

        made = {name: padded(name) for name in ("x", "y", "speed", "present", "length", "driven")}
        return cls(**made, end_m=torch.tensor([[row.end_m] for row in rows]))


def no_vehicles(batch: RecordingBatch, traffic: TrafficModule) -> Vehicles:
    """The state before any vehicle has entered."""
    zero = torch.zeros_like(batch.x[0])
    lane = torch.zeros_like(batch.present[0], dtype=torch.int64)
    return Vehicles(
        x=zero + _ABSENT_M,
        y=zero,
        heading=zero,
        speed=zero + 10.0,
        acceleration=zero,
        length=batch.length.clamp_min(1.0),
        width=zero + 2.0 * ENTRY_M,
        desired_speed=zero + 20.0,
        target_lane=lane,
        visibility=lane + int(traffic.visibility),
        valid=torch.zeros_like(batch.present[0]),
    )


def remove_finished(batch: RecordingBatch, state: Vehicles, step: int) -> Vehicles:
    """Removes vehicles whose recording is over or that passed the end of the road.

    Moves replayed ones on.
    """
    on_road = (state.x <= batch.end_m + _ROUNDING_M) | ~batch.driven
    stays = state.valid & batch.present[step] & on_road
    state = state.with_(valid=stays, x=torch.where(stays, state.x, _ABSENT_M))
    replayed = stays & ~batch.driven
    fields = ("x", "y", "speed")
    return state.with_(
        **{f: torch.where(replayed, getattr(batch, f)[step], getattr(state, f)) for f in fields}
    )


def may_enter(
    batch: RecordingBatch, state: Vehicles, waiting: Tensor, road: Road, step: int
) -> Tensor:
    """Vehicles that enter now, bool [N, M].

    Recorded in this frame, still waiting, and with room in their lane.
    """
    wants = batch.present[step] & waiting
    # Mostly no vehicle waits, and on a CPU the test costs nothing.
    if step == 0 or not bool(wants.any()):
        return wants
    same = road.lane_of(batch.y[step])[:, :, None] == road.lane_of(state.y)[:, None]
    between = (batch.x[step][:, :, None] - state.x[:, None]).abs()
    room = between - 0.5 * (batch.length[:, :, None] + state.length[:, None])
    return wants & ~(same & state.valid[:, None] & (room < ENTRY_GAP_M)).any(-1)


def insert_entering(
    batch: RecordingBatch,
    state: Vehicles,
    enters: Tensor,
    excess: Tensor,
    traffic: TrafficModule,
    step: int,
) -> Vehicles:
    """Puts the vehicles that enter into their recorded state, heading along the road.

    The others are unchanged.
    """
    x, y, speed = batch.x[step], batch.y[step], batch.speed[step].clamp_min(0.0)
    entered = state.with_(
        x=x,
        y=y,
        speed=speed,
        heading=torch.zeros_like(x),
        acceleration=torch.zeros_like(x),
        desired_speed=(speed + excess).clamp(SLOWEST_DESIRED_MPS, FASTEST_DESIRED_MPS),
        target_lane=traffic.road.lane_of(y).long(),
        valid=enters,
    )
    return entered.where(enters, state)


def with_recorded_headways(
    memory: TensorDictBase, vehicles: Vehicles, road: Road, who: Tensor
) -> TensorDictBase:
    """A traffic's ``memory`` with the headways that the entering drivers ``who`` [N, M] show in
    their recorded state.

    The memory, nested or not, is not modified; one without headways comes back equal.
    """

    def shown(name: str | tuple[str, ...], value: Tensor) -> Tensor:
        last = name if isinstance(name, str) else name[-1]
        return (
            torch.where(who, balanced_headway(vehicles, road, value), value)
            if last == "headway"
            else value
        )

    return memory.named_apply(shown, nested_keys=True)


class ConstantVelocity(TrafficModule):
    """Every vehicle keeps its lane and the speed at which it entered."""

    def move(
        self, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor
    ) -> tuple[Vehicles, dict]:
        """One step along the road."""
        v = vehicles
        return v.with_(x=v.x + v.speed * self.dt, acceleration=torch.zeros_like(v.speed)), memory


class RandomDriving(TrafficModule):
    """Drivers that ignore all others: the far end of the scale.

    An acceleration is drawn every second, uniform up to 3 m/s2 either way; a lane change to a
    random side starts at a constant hazard, every 20 s on average, and takes 4 s. Speeds are never
    negative.
    """

    hardest, every_s, change_s = 3.0, 20.0, 4.0

    def move(
        self, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor
    ) -> tuple[Vehicles, dict]:
        """One step: the second's acceleration, and towards the target lane."""
        v, m, dtype = vehicles, vehicles.x.shape[1], vehicles.x.dtype
        pace = uniform(
            key, torch.div(step, 10, rounding_mode="floor"), m, [Purpose.ACCELERATION], dtype
        )[..., 0]
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
    """IDM without lane changes, each driver with its own headway: generated traffic without its
    network.

    A control, none of the shipped traffics: Table V gives everybody the same headway. Here they are
    drawn from the recorded distribution, or taken from a recorded start.
    """

    memory_fields = {"headway": ((), None)}  # noqa: RUF012

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> dict[str, Tensor]:
        """A random headway for each driver."""
        u = uniform(key, -1, vehicles.x.shape[1], [Purpose.TRAIT_HEADWAY], vehicles.x.dtype)[..., 0]
        return {"headway": headway_from_uniform(u)}

    def move(
        self, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor
    ) -> tuple[Vehicles, dict]:
        """One step along the road."""
        v = vehicles
        wanted = following_acceleration(perceive(v, self.road), headway_s=memory["headway"])
        speed = (v.speed + wanted * self.dt).clamp_min(0.0)
        x = v.x + 0.5 * (v.speed + speed) * self.dt
        return v.with_(x=x, speed=speed, acceleration=(speed - v.speed) / self.dt), memory


#: Reference drivers at the ends of the scale.
FLOORS: dict[str, Factory] = {"random": RandomDriving, "constant_velocity": ConstantVelocity}
