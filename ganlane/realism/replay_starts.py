"""Recorded scenes driven by a traffic model: the same vehicles, on the same road, for as long as they were recorded.

A vehicle is driven from the frame at which it was first recorded to the one at which it was last recorded, or until
it passes the end of the recorded road. One that appears later waits while another stands in its place, and enters in
its recorded state at the first frame in which there is room. So the picture holds the same drivers at the same times
as the recording, whatever the model does. Index 0, the ego's, is not valid.

Others see a vehicle in the lane of its centre (and in its target lane, if it signals): recorded lanes are narrow and
straightened to some decimetres, so by their bodies one in ten would stand in two lanes at once.
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
from ganlane.evaluation.realism.headways import with_shown_headways
from ganlane.evaluation.realism.recordings import Recording, frame_of
from ganlane.evaluation.realism.script import Script, enter, enters, leave, parked
from ganlane.sim.random import Purpose, absorb, episode_key, uniform
from ganlane.sim.road import Road
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import TrafficModule

#: Makes a traffic model for a road.
Factory = Callable[[Road], TrafficModule]

#: Rows times vehicles times vehicles simulated at once; bounds the memory.
_MOST_PAIRS = 1_000_000


@dataclass(frozen=True)
class StartOptions:
    """How recorded scenes are driven.

    Attributes:
        desired_above_mps: desired speeds are the speed at entry and a uniform number from 0 on with this mean.
        repeats: times that every scene is driven, with different random numbers.
        seed: of the random numbers.
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
    """Rows of like lengths together, a batch no larger than memory should bear."""
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
    """One batch of recordings on one road, as one frame per row."""
    script, n = Script.of(rows), len(rows)
    counters = {keys.SEED: torch.full((n,), options.seed), keys.EPISODE: first + torch.arange(n)}
    key = episode_key(traffic.stream, counters[keys.SEED], counters[keys.EPISODE])
    u = uniform(key, 0, script.x.shape[2], [Purpose.SPAWN_DESIRED_SPEED])[..., 0]
    excess = 2.0 * options.desired_above_mps * u
    state = parked(script, traffic)
    memory: TensorDictBase | None = None
    course: dict[str, list[Tensor]] = {name: [] for name in ("x", "y", "valid")}
    waiting = torch.ones_like(script.present[0])
    for step in range(len(script.x)):
        state = leave(script, state, step)
        entering = enters(script, state, waiting, traffic.road, step)
        waiting = waiting & ~entering
        state = enter(script, state, entering, excess, traffic, step)
        memory = _renewed(traffic, state, memory, entering, absorb(key, 0))
        for name, values in course.items():
            values.append(getattr(state, name)[:, 1:])
        state, memory = step_traffic(traffic, state, memory, counters, step)
    arrays = {name: torch.stack(values).numpy() for name, values in course.items()}
    return [_frame(row, arrays, index, first + index) for index, row in enumerate(rows)]


def _frame(row: Recording, arrays: dict[str, np.ndarray], index: int, episode: int) -> pl.DataFrame:
    steps, vehicles = row.x.shape
    x, y, there = (arrays[name][:steps, index, :vehicles] for name in ("x", "y", "valid"))
    return frame_of(row, x, y, there, f"{row.name}#{episode}")


def step_traffic(
    traffic: TrafficModule, state: Vehicles, memory: TensorDictBase, counters: dict[str, Tensor], step: int
) -> tuple[Vehicles, TensorDictBase]:
    """Everybody at t + 0.1 s when the traffic drives alone, and its memory; who is not valid stays as it is."""
    batch = [state.x.shape[0]]
    view = TensorDict._new_unsafe(
        {
            keys.VEHICLES: TensorDict._new_unsafe(state.as_dict(), batch_size=torch.Size(batch)),
            keys.TRAFFIC: memory,
            **counters,
            keys.STEP: torch.full(batch, step),
        },
        batch_size=torch.Size(batch),
    )
    traffic(view)
    return Vehicles.of(view.get(keys.MOVED)).where(state.valid, state), view.get(keys.TRAFFIC)


def _renewed(
    traffic: TrafficModule, state: Vehicles, memory: TensorDictBase | None, enters: Tensor, key: Tensor
) -> TensorDictBase:
    """The traffic's memory, fresh for those who enter, with the headways that they show."""
    if memory is not None and not bool(enters.any()):
        return memory
    fresh = with_shown_headways(traffic.init_memory(state, enters, key), state, traffic.road, enters)
    if memory is None:
        return fresh

    def merged(new: Tensor, old: Tensor) -> Tensor:
        return torch.where(enters.reshape(*enters.shape, *[1] * (new.ndim - 2)), new, old)

    return fresh.apply(merged, memory)
