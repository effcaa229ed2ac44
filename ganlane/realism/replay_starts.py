"""Recorded scenes driven by a traffic model: the same vehicles and road, for as long as they were recorded.

A vehicle is driven from the frame at which it was first recorded to the one at which it was last recorded, or until
it passes the end of the recorded road. One that appears later waits while another occupies its place, and enters in
its recorded state at the first frame in which there is room. So simulation and recording hold the same drivers at the
same times, whatever the model does. Index 0, the ego's, is not valid.

Others perceive a vehicle in the lane of its centre (and in its target lane, if it signals): recorded lanes are narrow
and straightened to some decimetres, so by their bodies one vehicle in ten would occupy two lanes.

Headways: a driver recorded behind a leader has shown how closely it follows. With a headway drawn at random half of
the drivers would begin with hard braking, and the first seconds would measure nothing else. So a traffic with a
headway per driver (a memory ``headway`` [N, M] in s) starts with those that balance the recorded gaps. Traffic with
one headway for everybody (IDM, Table V) keeps it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import polars as pl
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.generator.rollout import balanced_headway
from ganlane.realism.recordings import Recording, frame_of
from ganlane.sim.random import Purpose, absorb, episode_key, uniform
from ganlane.sim.state import ENTRY_M, Road, Vehicles
from ganlane.traffic.base import TrafficModule

#: Makes a traffic model for a road.
Factory = Callable[[Road], TrafficModule]
#: A vehicle enters only where the gaps to those ahead and behind in its lane are at least this, m.
ENTRY_GAP_M = 2.0
#: Desired speeds are kept within these bounds, m/s.
SLOWEST_DESIRED_MPS, FASTEST_DESIRED_MPS = 5.0, 35.0
#: Name of the traffic memory that holds headways.
HEADWAY: Final = "headway"
#: Rows times vehicles times vehicles simulated at once; bounds the memory.
_MOST_PAIRS = 1_000_000
#: Position of absent vehicles, m.
_ABSENT_M = -10_000.0
#: Tolerance of positions, m.
_ROUNDING_M = 0.01
_FIELDS = ("x", "y", "speed")


@dataclass(frozen=True)
class StartOptions:
    """How recorded scenes are driven.

    Attributes:
        desired_above_mps: desired speeds are the speed at entry and a uniform number from 0 on with this mean.
        repeats: times that every scene is driven, with different random numbers.
    """

    desired_above_mps: float = 6.0
    repeats: int = 1
    seed: int = 0


def drive_recordings(make: Factory, recordings: Sequence[Recording], options: StartOptions) -> pl.DataFrame:
    """Drive every recording ``options.repeats`` times; the trajectories as :func:`frame_of` gives them.

    Recordings on equal roads are driven side by side.
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


def _drive(traffic: TrafficModule, rows: list[Recording], options: StartOptions, first: int) -> list[pl.DataFrame]:
    """Drives a batch of recordings on one road; one frame per row."""
    batch, n = RecordingBatch.of(rows), len(rows)
    counters = {keys.SEED: torch.full((n,), options.seed), keys.EPISODE: first + torch.arange(n)}
    key = episode_key(traffic.stream, counters[keys.SEED], counters[keys.EPISODE])
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
    traffic: TrafficModule, state: Vehicles, memory: TensorDictBase, counters: dict[str, Tensor], step: int
) -> tuple[Vehicles, TensorDictBase]:
    """State and memory at t + 0.1 s when the traffic drives without an ego; invalid vehicles stay as they are."""
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
    traffic: TrafficModule, state: Vehicles, memory: TensorDictBase | None, enters: Tensor, key: Tensor
) -> TensorDictBase:
    """The traffic's memory, initialised for the vehicles that enter, with their recorded headways."""
    if memory is not None and not bool(enters.any()):
        return memory
    fresh = with_recorded_headways(traffic.init_memory(state, key), state, traffic.road, enters)
    if memory is None:
        return fresh

    def merged(new: Tensor, old: Tensor) -> Tensor:
        return torch.where(enters.reshape(*enters.shape, *[1] * (new.ndim - 2)), new, old)

    return fresh.apply(merged, memory)


@dataclass(frozen=True)
class RecordingBatch:
    """Recordings side by side, padded with absent vehicles; index 0 is the ego's and absent.

    ``x``, ``y``, ``speed`` and ``present`` are [T, N, M], ``length`` and ``driven`` [N, M]; ``end_m`` [N, 1] is where
    each road ends, m.
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
            whole = np.zeros((*([steps] if values[0].ndim == 2 else []), len(rows), most + 1), dtype=values[0].dtype)
            for index, value in enumerate(values):
                where = (slice(len(value)), index) if value.ndim == 2 else (index,)
                whole[(*where, slice(1, value.shape[-1] + 1))] = value
            made = torch.from_numpy(whole)
            return made.float() if made.is_floating_point() else made

        x, y, speed = padded("x"), padded("y"), padded("speed")
        end_m = torch.tensor([[row.end_m] for row in rows])
        return cls(x, y, speed, padded("present"), padded("length"), padded("driven"), end_m)


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
    """Removes vehicles whose recording is over or that passed the end of the road; moves replayed ones on."""
    on_road = (state.x <= batch.end_m + _ROUNDING_M) | ~batch.driven
    stays = state.valid & batch.present[step] & on_road
    state = state.with_(valid=stays, x=torch.where(stays, state.x, _ABSENT_M))
    replayed = stays & ~batch.driven
    shown = {name: torch.where(replayed, getattr(batch, name)[step], getattr(state, name)) for name in _FIELDS}
    return state.with_(**shown)


def may_enter(batch: RecordingBatch, state: Vehicles, waiting: Tensor, road: Road, step: int) -> Tensor:
    """Vehicles that enter now, bool [N, M]: recorded in this frame, still waiting, and with room in their lane."""
    wants = batch.present[step] & waiting
    # Mostly no vehicle waits, and on a CPU the test costs nothing.
    if step == 0 or not bool(wants.any()):
        return wants
    same = road.lane_of(batch.y[step])[:, :, None] == road.lane_of(state.y)[:, None]
    between = (batch.x[step][:, :, None] - state.x[:, None]).abs()
    room = between - 0.5 * (batch.length[:, :, None] + state.length[:, None])
    return wants & ~(same & state.valid[:, None] & (room < ENTRY_GAP_M)).any(-1)


def insert_entering(
    batch: RecordingBatch, state: Vehicles, enters: Tensor, excess: Tensor, traffic: TrafficModule, step: int
) -> Vehicles:
    """Puts the vehicles that enter into their recorded state, heading along the road; the others are unchanged."""
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


def with_recorded_headways(memory: TensorDictBase, vehicles: Vehicles, road: Road, who: Tensor) -> TensorDictBase:
    """A traffic's ``memory`` with the headways that the entering drivers ``who`` [N, M] show in their recorded state.

    The memory, nested or not, is not modified; one without headways comes back equal.
    """

    def shown(name: str | tuple[str, ...], value: Tensor) -> Tensor:
        last = name if isinstance(name, str) else name[-1]
        return torch.where(who, balanced_headway(vehicles, road, value), value) if last == HEADWAY else value

    return memory.named_apply(shown, nested_keys=True)
