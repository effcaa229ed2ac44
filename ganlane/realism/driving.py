"""Recorded scenes driven by a traffic: the same vehicles and road, for as long as recorded.

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

Two drivers mark the ends of the scale: random driving and constant velocity.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import pad

from ganlane import keys
from ganlane.data.dense import Recording
from ganlane.generator.closed_loop import balanced_headway
from ganlane.sim.random import Purpose, episode_key, uniform
from ganlane.sim.state import ENTRY_M, Road, Vehicles
from ganlane.traffic.base import Memory, Moved, TrafficModule, new_tensordict, uniforms
from ganlane.traffic.overlays import random_side

#: Makes a traffic model for a road.
Factory = Callable[[Road], TrafficModule]
#: A vehicle enters only where the gaps to those ahead and behind in its lane are at least this, m.
ENTRY_GAP_M = 2.0
#: Desired speeds are kept within these bounds, m/s.
SLOWEST_DESIRED_MPS = 5.0
FASTEST_DESIRED_MPS = 35.0
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
        seed: of the random numbers.
    """

    desired_above_mps: float = 6.0
    repeats: int = 1
    seed: int = 0


def print_progress(text: str) -> None:
    """Print a line of progress on stderr."""
    print(text, file=sys.stderr, flush=True)


def drive_recordings(
    make: Factory,
    recordings: Sequence[Recording],
    options: StartOptions,
) -> list[Recording]:
    """Let a traffic drive from the start of every recording, ``options.repeats`` times.

    Args:
        make: makes the traffic, for the road of each recording.
        recordings: scenes on roads of any shape; those on equal roads go side by side.
        options: desired speeds, repeats and seed.

    Returns:
        What was driven, in any order, under the recordings' units.
    """
    # A traffic is made for one road.
    roads: dict[tuple[int, float], list[Recording]] = {}
    for recording in recordings:
        same_road = roads.setdefault((recording.lanes, recording.lane_width_m), [])
        same_road += [recording] * options.repeats

    driven: list[Recording] = []
    for road, rows in roads.items():
        for batch in _batches(rows):
            # Each row has an episode number of its own, whatever the batches are.
            first = len(driven)
            driven += _drive(make(Road(*road)), batch, options, first)
    return driven


def _batches(rows: list[Recording]) -> list[list[Recording]]:
    """Rows of similar shapes together, at most :data:`_MOST_PAIRS` pairs of vehicles in a batch."""
    batches: list[list[Recording]] = []
    # Sorted by shape, so that little is padded.
    for row in sorted(rows, key=lambda row: row.x.shape):
        last = batches[-1] if batches else []

        # Every vehicle looks at every other, so memory grows with the square of the largest scene.
        most = max(len(other.length) for other in [row, *last])
        if batches and (len(last) + 1) * most * most <= _MOST_PAIRS:
            last.append(row)
        else:
            batches.append([row])
    return batches


def _drive(
    traffic: TrafficModule,
    rows: list[Recording],
    options: StartOptions,
    first: int,
) -> list[Recording]:
    """Drives a batch of N recordings on one road; ``first`` is the episode of the first of them."""
    recorded = StackedRecordings(rows)
    n = len(rows)

    # Random numbers depend on seed and episode alone.
    counters = {
        keys.SEED: torch.full((n,), options.seed),
        keys.EPISODE: first + torch.arange(n),
    }
    key = episode_key(traffic.stream, *counters.values())

    # What drivers desire above their speed at entry, m/s, [N, M]: uniform, with the wanted mean.
    u = uniform(key, 0, recorded.x.shape[2], [Purpose.SPAWN_DESIRED_SPEED])[..., 0]
    excess = 2.0 * options.desired_above_mps * u

    # Nobody has entered: everybody waits, far behind the road's beginning.
    state = recorded.entering(0, excess, traffic)
    waiting = state.valid
    state = state.with_(x=torch.full_like(state.x, _ABSENT_M), valid=~waiting)
    # Only its shape counts: whoever enters gets a memory of its own.
    _, memory = traffic.enter(state, key, counters[keys.EPISODE])

    # Positions of every step, before the step is driven.
    course = []
    for step in range(len(recorded.x)):
        state = recorded.without_finished(state, step)

        # Who has entered once does not enter again.
        enters = recorded.may_enter(state, waiting, traffic.road, step)
        waiting = waiting & ~enters
        state = recorded.entering(step, excess, traffic).where(enters, state)

        if bool(enters.any()):
            # Drawn for all, and taken for those who enter.
            _, fresh = traffic.enter(state, key, counters[keys.EPISODE])
            fresh = with_recorded_headways(fresh, state, traffic.road, enters)
            memory = fresh.apply(partial(_of_those, enters), memory)

        course.append((state.x, state.y, state.valid))
        state, memory = step_traffic(traffic, state, memory, counters, step)

    # Each [T, N, M], without the ego's empty place.
    x, y, valid = (torch.stack(values)[..., 1:].numpy() for values in zip(*course))

    driven = []
    for index, row in enumerate(rows):
        # Without what was padded: [T, M] of this recording.
        steps, vehicles = row.x.shape
        part = (slice(steps), index, slice(vehicles))
        driven.append(
            replace(
                row,
                # The number tells the repeats of a scene apart.
                name=f"{row.name}#{first + index}",
                x=x[part],
                y=y[part],
                present=valid[part],
            )
        )
    return driven


def step_traffic(
    traffic: TrafficModule,
    state: Vehicles,
    memory: TensorDictBase,
    counters: dict[str, Tensor],
    step: int,
) -> tuple[Vehicles, TensorDictBase]:
    """State and memory at t + 0.1 s when the traffic drives without an ego.

    Args:
        traffic: of one road.
        state: vehicles [N, M]; those that are not valid stay as they are.
        memory: of the traffic, as :meth:`~ganlane.traffic.TrafficModule.enter` gave it.
        counters: seed and episode [N] by key; not modified.
        step: physics steps since the start.
    """
    n = len(state.x)

    # What an environment would hand to its traffic, without an ego.
    fields = {
        keys.VEHICLES: new_tensordict(state.as_dict(), n),
        keys.TRAFFIC: memory,
        **counters,
        keys.STEP: torch.full((n,), step),
    }
    view = new_tensordict(fields, n)
    traffic(view)

    moved = Vehicles.of(view.get(keys.MOVED))
    return moved.where(state.valid, state), view.get(keys.TRAFFIC)


def _of_those(who: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """The ``new`` values [N, M, ...] of the vehicles ``who`` [N, M], the ``old`` of the others."""
    # As many dimensions as the values have, for those that hold more than a number per vehicle.
    matching = who.reshape(*who.shape, *[1] * (new.ndim - 2))
    return torch.where(matching, new, old)


class StackedRecordings:
    """N recordings as tensors, padded with absent vehicles; index 0 is the ego's and absent.

    T and M - 1 are the most frames and vehicles of a recording.

    Attributes:
        x, y: positions of the centres, m, [T, N, M].
        speed: m/s, [T, N, M].
        present: whether a vehicle is recorded in a frame, [T, N, M].
        driven: whether the traffic drives it; others are replayed, [N, M].
        length: m, [N, M].
        end_m: where each road ends, m, [N, 1].
    """

    def __init__(self, rows: Sequence[Recording]) -> None:
        steps = max(row.x.shape[0] for row in rows)
        most = max(row.x.shape[1] for row in rows)

        def stacked(name: str) -> Tensor:
            """A field of all recordings; numbers in single precision, as in the simulation."""
            padded = []
            for row in rows:
                value = torch.from_numpy(getattr(row, name))
                # Index 0 of the vehicles is the ego's; later frames are empty.
                below = [0, steps - len(value)] if value.ndim == 2 else []
                padded.append(pad(value, [1, most - value.shape[-1], *below]))

            # Rows before vehicles, behind the frames, if there are any.
            tensor = torch.stack(padded, dim=-2)
            return tensor.float() if tensor.is_floating_point() else tensor

        self.x = stacked("x")
        self.y = stacked("y")
        self.speed = stacked("speed")
        self.present = stacked("present")
        self.driven = stacked("driven")
        self.length = stacked("length")
        self.end_m = torch.tensor([[row.end_m] for row in rows])

    def without_finished(self, state: Vehicles, step: int) -> Vehicles:
        """Removes vehicles whose recording is over or that passed the end of the road.

        Moves replayed ones on.

        Args:
            state: vehicles [N, M] before ``step``.
            step: the frame that is to be driven from.
        """
        # Replayed vehicles leave when their recording ends, no earlier.
        on_road = (state.x <= self.end_m + _ROUNDING_M) | ~self.driven
        stays = state.valid & self.present[step] & on_road
        state = state.with_(x=torch.where(stays, state.x, _ABSENT_M), valid=stays)

        # These are where they were recorded, whatever the traffic did with them.
        replayed = state.with_(x=self.x[step], y=self.y[step], speed=self.speed[step])
        return replayed.where(stays & ~self.driven, state)

    def may_enter(self, state: Vehicles, waiting: Tensor, road: Road, step: int) -> Tensor:
        """Vehicles that enter now, bool [N, M].

        Recorded in this frame, still waiting, and with room in their lane. At the first frame all
        enter: they were recorded so.

        Args:
            state: vehicles [N, M] on the road.
            waiting: who has not entered yet, [N, M].
            road: for their lanes.
            step: the frame.
        """
        wants = self.present[step] & waiting
        # Mostly no vehicle waits, which saves the test of all pairs.
        if step == 0 or not bool(wants.any()):
            return wants

        # Pairs [N, M, M] of who enters and who is there.
        lane = road.lane_of(self.y[step])
        same_lane = lane[:, :, None] == road.lane_of(state.y)[:, None]
        between_m = (self.x[step][:, :, None] - state.x[:, None]).abs()
        gap_m = between_m - 0.5 * (self.length[:, :, None] + state.length[:, None])

        blocked = same_lane & state.valid[:, None] & (gap_m < ENTRY_GAP_M)
        return wants & ~blocked.any(-1)

    def entering(self, step: int, excess: Tensor, traffic: TrafficModule) -> Vehicles:
        """All vehicles [N, M] in their recorded state of frame ``step``, heading along the road.

        ``excess`` [N, M] is what they desire above this speed, m/s. All are valid, also those that
        are not recorded here: :meth:`may_enter` says who enters.
        """
        y = self.y[step]
        speed = self.speed[step].clamp_min(0.0)
        desired = (speed + excess).clamp(SLOWEST_DESIRED_MPS, FASTEST_DESIRED_MPS)
        zero = torch.zeros_like(y)
        return Vehicles(
            x=self.x[step],
            y=y,
            heading=zero,
            speed=speed,
            acceleration=zero,
            # Places without a vehicle have length 0, which is no body.
            length=self.length.clamp_min(1.0),
            # So narrow that it occupies the lane of its centre alone.
            width=zero + 2.0 * ENTRY_M,
            desired_speed=desired,
            target_lane=traffic.road.lane_of(y).long(),
            visibility=zero.long() + int(traffic.visibility),
            valid=zero == 0.0,
        )


def with_recorded_headways(
    memory: TensorDictBase,
    vehicles: Vehicles,
    road: Road,
    who: Tensor,
) -> TensorDictBase:
    """A traffic's ``memory`` with the headways that the drivers ``who`` [N, M] show as they enter.

    Args:
        memory: nested or not; it is not modified, and one without headways comes back equal.
        vehicles: [N, M], those that enter among them.
        road: for their lanes.
        who: enters now, [N, M] bool; the others keep their headways.
    """

    def shown(name: str | tuple[str, ...], value: Tensor) -> Tensor:
        # A nested memory has its names as tuples.
        if name != "headway" and name[-1] != "headway":
            return value
        return torch.where(who, balanced_headway(vehicles, road, value), value)

    return memory.named_apply(shown, nested_keys=True)


class ConstantVelocity(TrafficModule):
    """Every vehicle keeps its lane and the speed at which it entered.

    Like random driving it ignores all others.
    """

    def move(self, vehicles: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        """One step along the road; the memory stays as it is."""
        moved = vehicles.with_(
            x=vehicles.x + vehicles.speed * self.dt,
            acceleration=torch.zeros_like(vehicles.speed),
        )
        return moved, memory


class RandomDriving(TrafficModule):
    """Drivers that ignore all others: the far end of the scale.

    An acceleration is drawn every second, uniform up to 3 m/s2 either way; a lane change to a
    random side starts at a constant hazard, every 20 s on average, and takes 4 s. Speeds are never
    negative.

    Attributes:
        hardest: the highest acceleration either way, m/s2.
        every_s: mean time between two lane changes, s.
        change_s: duration of a lane change, s.
    """

    hardest = 3.0
    every_s = 20.0
    change_s = 4.0

    def move(self, vehicles: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        """One step: the second's acceleration, and towards the target lane.

        The random numbers depend on ``key`` and ``step`` alone; the memory stays as it is.
        """
        v = vehicles

        # One acceleration for the ten steps of a second.
        second = torch.div(step, 10, rounding_mode="floor")
        (pace,) = uniforms(v, key, second, Purpose.ACCELERATION)
        acceleration = self.hardest * (2.0 * pace - 1.0)
        speed = (v.speed + acceleration * self.dt).clamp_min(0.0)

        purposes = (Purpose.LANE_CHANGE_HAZARD, Purpose.LANE_CHANGE_SIDE)
        hazard, chosen = uniforms(v, key, step, *purposes)
        # What is left of the way to the target lane's centre, m.
        remaining = self.road.centre_of(v.target_lane, v.x.dtype) - v.y
        # Nobody starts a change during another one.
        starts = (hazard < self.dt / self.every_s) & (remaining.abs() < 0.3)
        side = torch.where(starts, random_side(chosen, v.target_lane, self.road.lanes), 0)

        # Sideways at a constant speed, and no further than the lane's centre.
        stride = self.road.lane_width_m * self.dt / self.change_s
        aside = (remaining / stride).clamp(-1.0, 1.0) * stride

        moved = v.with_(
            # At the mean of both speeds.
            x=v.x + 0.5 * (v.speed + speed) * self.dt,
            y=v.y + aside,
            speed=speed,
            # What is left of it where the vehicle stops.
            acceleration=(speed - v.speed) / self.dt,
            target_lane=v.target_lane + side,
        )
        return moved, memory


#: Reference drivers at the ends of the scale.
FLOORS: dict[str, Factory] = {
    "random": RandomDriving,
    "constant_velocity": ConstantVelocity,
}
