"""Long runs without an ego: what a traffic does over minutes and 5000 m.

Vehicles start as the simulator's own episodes do (Table II), on the paper's road, and drive until
everybody is expected to have covered 5000 m. Index 0, the ego's, is not valid. Results are rates
with exact intervals, speeds over time, and quantiles.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ganlane import keys
from ganlane.data.lanes import Tracks, find_lane_changes
from ganlane.keys import PHYSICS_STEP_S
from ganlane.realism.driving import Factory, print_progress, step_traffic
from ganlane.realism.measures import rate_entries
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.neighbours import leader, perceive
from ganlane.sim.random import episode_key
from ganlane.sim.spawn import TABLE_II, RandomScenes, SpawnParameters
from ganlane.sim.state import Road, Vehicles, lateral_half_extent
from ganlane.traffic import TrafficModule

#: Times at which speeds are summarised, s, by name.
SPEEDS_AT_S = {
    "10 s": 10.0,
    "60 s": 60.0,
    "150 s": 150.0,
    "300 s": 300.0,
}
#: The goal by its name, and its distance, m.
GOAL = "5000 m"
GOAL_M = 5000.0
#: Samples of one batch (times, rows, vehicles); bounds the memory.
_MOST_SAMPLES = 12_000_000
#: Episodes of one batch.
_MOST_ROWS = 64
#: A body further beyond the edge than this is off the road, m; less is rounding.
EDGE_M: Final = 0.01
#: A vehicle slower than this with a leader no nearer than that has stopped without reason, m/s and
#: m.
STANDING_MPS: Final = 1.0
FREE_M: Final = 50.0


@dataclass(frozen=True)
class LongRunParameters:
    """Length and size of a long run.

    Attributes:
        vehicles: of an episode, none of them an ego.
        vehicle_km: at least so many are driven.
        most_s: no episode lasts longer, s; it ends when its vehicles have covered 5000 m on average
            and 5 minutes have passed.
        seed: of the random numbers.
        spawn: Table II; the spread grows with the vehicles at the paper's density.
    """

    vehicles: int = 9
    vehicle_km: float = 3000.0
    most_s: float = 600.0
    seed: int = 0
    spawn: SpawnParameters = TABLE_II


class Trajectories(NamedTuple):
    """Vehicles of a batch without ego, from the start on, 0.1 s apart.

    Attributes:
        x, y: positions of the centres, m, [T, N, M].
        speed: m/s, [T, N, M].
        length, width: of the bodies, m, [N, M].
    """

    x: np.ndarray
    y: np.ndarray
    speed: np.ndarray
    length: np.ndarray
    width: np.ndarray


class EventCounter:
    """Counts onsets; index 0 (the ego's) and vehicles that are not valid do not count.

    Attributes:
        overlaps: pairs of vehicles whose boxes began to overlap.
        off_road: vehicles whose body began to reach beyond the edge of the road.
        standstills: vehicles that began to stand still in free flow.
    """

    def __init__(self, road: Road) -> None:
        self.road = road
        self.overlaps = 0
        self.off_road = 0
        self.standstills = 0
        #: The last state; empty where a new batch of episodes begins.
        self.before: dict[str, Tensor] = {}

    def count(self, vehicles: Vehicles, step: int) -> None:
        """Count the events of a physics step.

        Args:
            vehicles: [N, M + 1] after the step, the ego's empty place first.
            step: its number since the episodes began.
        """
        # Everything is counted without the ego's empty place.
        others = vehicles.columns(slice(1, None))

        # Above the diagonal, so that a pair counts once.
        pairs = pair_overlaps(others).triu(1)
        self.overlaps += self._onsets("overlap", pairs)

        # Half the width of a body, turned with its heading.
        half = lateral_half_extent(others) - EDGE_M
        left = self.road.left_edge_m()
        right = self.road.right_edge_m()
        outside = (others.y + half > left) | (others.y - half < right)
        self.off_road += self._onsets("off_road", outside & others.valid)

        # Standstills last, and to look for leaders is dear: once a second is enough.
        if step % 10 == 9:
            slow = (vehicles.speed < STANDING_MPS) & vehicles.valid
            # Standing behind somebody is queueing, no standstill.
            ahead = leader(perceive(vehicles, self.road), self.road.lane_of(vehicles.y))
            free = ahead.gap > FREE_M
            # Leaders are looked for among all, so only here the ego's place goes.
            self.standstills += self._onsets("standstill", (slow & free)[:, 1:])

    def _onsets(self, name: str, now: Tensor) -> int:
        """Number of entries that are true now and were not at the last count."""
        # An event counts when it begins, however long it lasts.
        before = self.before.get(name, torch.zeros_like(now))
        self.before[name] = now
        return int((now & ~before).sum())


def long_run(
    make: Factory,
    road: Road,
    parameters: LongRunParameters,
    name: str = "traffic",
) -> dict[str, Any]:
    """Drive ``parameters.vehicle_km``, batch after batch.

    Args:
        make: makes the traffic.
        road: on which it drives.
        parameters: vehicles, length and seed.
        name: of the traffic, under which the progress is printed.

    Returns:
        ``vehicles``, ``episodes`` and ``vehicle_km`` that were driven; the counts ``lane_changes``,
        ``overlaps``, ``off_road`` and ``standstills_in_free_flow``, and what :func:`rates` makes of
        the first two; ``lane_change_duration_mean_s`` of the complete changes (None without any);
        ``acceleration_quantiles``, m/s2, by level as text; and ``speeds``, :func:`mean_speeds` by
        the names of :data:`SPEEDS_AT_S` and :data:`GOAL`.
    """
    traffic = make(road)
    events = EventCounter(road)

    batches = []
    km = 0.0
    episodes = 0
    moving = True
    # Ends early where nobody moves.
    while km < parameters.vehicle_km and moving:
        rows = _rows(parameters, parameters.vehicle_km - km)
        driven = drive_spawned(traffic, parameters, episodes, rows, events)
        batches.append(batch_samples(driven, road))

        # In double precision: thousands of distances are added up.
        way_m = driven.x[-1] - driven.x[0]
        batch_km = float(way_m.sum(dtype=np.float64)) / 1000.0
        moving = batch_km > 0.0
        km += batch_km
        episodes += rows
        print_progress(
            f"{name}, long run of {parameters.vehicles} vehicles: {km:.0f} of "
            f"{parameters.vehicle_km:g} vehicle-km"
        )

    # The samples of all batches, by name.
    samples = {}
    for kind in batches[0]:
        samples[kind] = np.concatenate([batch[kind] for batch in batches])

    # A change that was cut off by the end of an episode counts, but has no duration.
    changes = len(samples["duration"])
    durations = samples["duration"][samples["complete"]]
    quantiles = {}
    for level in (0.05, 0.95):
        quantiles[f"{level:g}"] = float(np.quantile(samples["acceleration"], level))

    # From the episodes that lasted so long, or came so far.
    speeds = {time: mean_speeds(samples[time]) for time in SPEEDS_AT_S}
    speeds[GOAL] = mean_speeds(samples[GOAL], after_s=samples["after_s"])

    return {
        "vehicles": parameters.vehicles,
        "episodes": episodes,
        "vehicle_km": km,
        "lane_changes": changes,
        "lane_change_duration_mean_s": float(durations.mean()) if len(durations) else None,
        "overlaps": events.overlaps,
        **rates(changes, events.overlaps, km),
        "off_road": events.off_road,
        "standstills_in_free_flow": events.standstills,
        "acceleration_quantiles": quantiles,
        "speeds": speeds,
    }


def _rows(parameters: LongRunParameters, km: float) -> int:
    """Number of parallel episodes for ``km`` vehicle-km.

    Each vehicle is taken to cover a little less than 5000 m.
    """
    # 14 m/s is a slow traffic's mean speed: rather too many than too few.
    expected_km = parameters.vehicles * min(4.8, 0.014 * parameters.most_s)

    # As many samples as the memory holds.
    steps = round(parameters.most_s / PHYSICS_STEP_S)
    most = min(_MOST_ROWS, _MOST_SAMPLES // (steps * parameters.vehicles))

    # Not more rows than the remaining kilometres ask for.
    return max(1, min(math.ceil(km / expected_km), most))


def spawned_vehicles(
    traffic: TrafficModule,
    parameters: LongRunParameters,
    key: Tensor,
) -> Vehicles:
    """The vehicles [N, M + 1] at the start of the episodes ``key`` [N].

    Index 0, an ego's, is not valid.
    """
    # Table II's density, for the vehicles and an empty place for the ego.
    spread_m = parameters.spawn.spread_m * (parameters.vehicles + 1) / 9.0
    # Fewer vehicles keep Table II's spread.
    start = replace(parameters.spawn, spread_m=max(parameters.spawn.spread_m, spread_m))
    scenes = RandomScenes(
        traffic.road,
        parameters.vehicles + 1,
        start,
        others_visibility=int(traffic.visibility),
    )
    vehicles = scenes(key, torch.float32)

    # Spawned with an ego, since Table II has one, and driven without it.
    index = torch.arange(parameters.vehicles + 1)
    return vehicles.with_(valid=vehicles.valid & (index > 0))


def drive_spawned(
    traffic: TrafficModule,
    parameters: LongRunParameters,
    first: int,
    rows: int,
    events: EventCounter,
) -> Trajectories:
    """Drive one batch of spawned episodes.

    It ends when the vehicles of every episode have covered 5000 m on average and 5 minutes have
    passed, or after ``parameters.most_s``.

    Args:
        traffic: of one road.
        parameters: vehicles, length and seed.
        first: number of the first episode.
        rows: episodes side by side.
        events: counts what happens.
    """
    # Numbers go on from batch to batch, so that no episode is driven twice.
    counters = {
        keys.SEED: torch.full((rows,), parameters.seed),
        keys.EPISODE: first + torch.arange(rows),
    }
    key = episode_key(traffic.stream, *counters.values())
    state = spawned_vehicles(traffic, parameters, key)
    _, memory = traffic.enter(state, key, counters[keys.EPISODE])
    start = state.x
    course = [(state.x, state.y, state.speed)]

    # Onsets do not carry over from the batch before.
    events.before.clear()
    for step in range(round(parameters.most_s / PHYSICS_STEP_S)):
        state, memory = step_traffic(traffic, state, memory, counters, step)
        events.count(state, step)
        course.append((state.x, state.y, state.speed))

        # Distances are tested once in ten seconds of driving: cheap, and exact enough.
        due = step % 100 == 99 and step * PHYSICS_STEP_S >= max(SPEEDS_AT_S.values())
        if due and bool(((state.x - start)[:, 1:].mean(1) >= GOAL_M).all()):
            break

    # Without the ego's empty place.
    x, y, speed = (torch.stack(values)[..., 1:].numpy() for values in zip(*course))
    length = state.length[:, 1:].numpy()
    width = state.width[:, 1:].numpy()
    return Trajectories(x, y, speed, length, width)


def batch_samples(trajectories: Trajectories, road: Road) -> dict[str, np.ndarray]:
    """Samples of one batch, driven on ``road``.

    Returns:
        Of every lane change its ``duration`` in s and whether it is ``complete``;
        ``acceleration``, m/s2; speeds [R, K] of the R episodes that lasted so long
        (:data:`SPEEDS_AT_S`) or came so far (:data:`GOAL`), m/s, and when the latter came there,
        ``after_s``.
    """
    # Every vehicle of every episode is a track of its own, present all the time.
    y = trajectories.y.reshape(len(trajectories.y), -1).astype(np.float64)
    # One track behind the other: each begins after as many samples as there are times.
    begins = np.arange(y.size) % len(y) == 0
    widths = np.full(y.size, float(road.lane_width_m))
    tracks = Tracks(y.T.ravel(), widths, begins)
    changes = find_lane_changes(tracks)

    second = round(1.0 / PHYSICS_STEP_S)
    x = trajectories.x.astype(np.float64)
    # The same filter as for recordings; one sample a second is enough.
    before = x[: -2 * second : second]
    middle = x[second:-second:second]
    after = x[2 * second :: second]
    bend = after - 2.0 * middle + before

    speeds = {}
    for name, seconds in SPEEDS_AT_S.items():
        time = round(seconds / PHYSICS_STEP_S)
        # An episode that ended earlier says nothing about this time.
        lasted = trajectories.speed[time : time + 1]
        # [1, N, M] or [0, N, M] to [N, M] or [0, M].
        speeds[name] = lasted.reshape(-1, lasted.shape[-1])

    # The first time at which the episode's vehicles have covered 5000 m on average, [T, N].
    there = (trajectories.x - trajectories.x[:1]).mean(-1) >= GOAL_M
    arrived = np.flatnonzero(there.any(0))
    times = there.argmax(0)[arrived]

    return {
        "duration": changes.duration_s,
        "complete": changes.complete,
        "acceleration": bend.ravel(),
        **speeds,
        GOAL: trajectories.speed[times, arrived],
        "after_s": times * PHYSICS_STEP_S,
    }


def mean_speeds(speed: np.ndarray, **others: np.ndarray) -> dict[str, float | int | None]:
    """Means over episodes of the mean and the standard deviation of their vehicles' speeds.

    Args:
        speed: of K vehicles in R episodes, m/s, [R, K].
        others: what else is averaged over the episodes, [R], by name.

    Returns:
        ``mean_speed_mps``, ``spread_mps`` and the ``others``, None without episodes; ``episodes``
        is R.
    """
    speed = speed.astype(np.float64)
    # A single vehicle has no spread.
    spread = speed.std(-1, ddof=1) if speed.shape[-1] > 1 else np.zeros(len(speed))
    of_episodes = {
        "mean_speed_mps": speed.mean(-1),
        "spread_mps": spread,
        **others,
    }

    means = {}
    for name, values in of_episodes.items():
        means[name] = float(values.mean()) if len(values) else None
    return {**means, "episodes": len(speed)}


def rates(lane_changes: int, overlaps: int, km: float) -> dict[str, Any]:
    """Both counts per vehicle-km and per 1000 of them, with exact 95 % intervals.

    None where no vehicle moved.
    """
    return {
        **rate_entries("lane_changes_per_vehicle_km", lane_changes, km),
        **rate_entries("overlaps_per_1000_vehicle_km", overlaps, km, per_km=1000.0),
    }


def totals(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Event counts and rates over all long runs, with exact 95 % intervals; None without any."""

    def total(name: str) -> Any:
        return sum(run[name] for run in runs)

    return {
        "off_road": total("off_road") if runs else None,
        "standstills_in_free_flow": total("standstills_in_free_flow") if runs else None,
        **rates(total("lane_changes"), total("overlaps"), total("vehicle_km")),
    }
