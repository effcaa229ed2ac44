"""Scenes for tests.

Vehicles placed by hand, environments in one line, states turned into scalar cars.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from reference import scalar
from tensordict import TensorDict, TensorDictBase

from ganlane import keys
from ganlane.env import EpisodeParameters, HighwayEnv
from ganlane.settings.actions import ActionParameters
from ganlane.settings.driving import EgoParameters, Visibility
from ganlane.settings.episode import SpawnParameters
from ganlane.settings.road import EXIT, FAR_M, NOTHING, WALL, FlowParameters, LaneStretch, Stretches
from ganlane.sim.idm import TABLE_V
from ganlane.sim.random import Stream, episode_key
from ganlane.sim.state import Road, Vehicles
from ganlane.traffic.base import TrafficModule
from ganlane.traffic.idm_mobil import IdmMobilTraffic, IdmTraffic

DOUBLE = torch.float64
DEFAULTS = {
    "x": 0.0,
    "heading": 0.0,
    "speed": 20.0,
    "acceleration": 0.0,
    "length": 4.5,
    "width": 2.5,
    "desired_speed": 25.0,
    "visibility": int(Visibility.SIGNALLED),
    "valid": True,
}


def vehicles(*cars: dict, dtype: torch.dtype = DOUBLE) -> Vehicles:
    """One row of cars, each a dict of fields.

    ``lane`` gives y and target lane, of lanes of 4 m, unless they are named.
    """
    columns = []
    for name in keys.VEHICLE_FIELDS:
        # Whole numbers and flags tell their own types.
        kind = dtype if name in keys.VEHICLE_FLOATS else None
        columns.append(torch.tensor([[field_of(car, name) for car in cars]], dtype=kind))
    return Vehicles(*columns)


def field_of(car: dict, name: str) -> float:
    """What a car says of itself, or else its lane, or else :data:`DEFAULTS`."""
    lane = car.get("lane", 0)
    return {**DEFAULTS, "y": 4.0 * lane, "target_lane": lane, **car}[name]


def episode_keys(episodes: Sequence[int], stream: int = 0, seed: int = 0) -> torch.Tensor:
    """The keys of these episodes of a seed."""
    number = torch.as_tensor(episodes)
    return episode_key(stream, torch.full_like(number, seed), number)


def drawing(
    shape: Sequence[int], seed: int | torch.Generator, dtype: torch.dtype = DOUBLE
) -> Callable[[float, float], torch.Tensor]:
    """``between(low, high)``, which draws uniform numbers of that shape."""
    generator = torch.Generator().manual_seed(seed) if isinstance(seed, int) else seed
    return lambda low, high: (
        low + (high - low) * torch.rand(shape, generator=generator, dtype=dtype)
    )


def vehicles_at(x: torch.Tensor, target_lane: torch.Tensor, **others: torch.Tensor) -> Vehicles:
    """Cars [N, M] in the middle of their target lanes, straight ahead and signalled, but for the
    ``others``.
    """
    fields = {name: torch.full_like(x, DEFAULTS.get(name, 0.0)) for name in keys.VEHICLE_FLOATS}
    fields |= {
        "x": x,
        "y": 4.0 * target_lane.to(x.dtype),
        "target_lane": target_lane,
        "visibility": torch.full_like(target_lane, DEFAULTS["visibility"]),
        "valid": target_lane >= 0,
    }
    return Vehicles(**{**fields, **others})


def random_scenes(rows: int, cars: int, lanes: int, seed: int) -> Vehicles:
    """On 400 m, at 0 to 35 m/s, one in five in the middle of a change, all of them signalled."""
    between = drawing((rows, cars), seed)
    lane = between(0, lanes).long()
    side = (between(0, 2).long() * 2 - 1) * (between(0, 1) < 0.2)
    target = (lane + side).clamp(0, lanes - 1)
    speed = between(0, 35)
    x = between(0, 400)
    y = 4.0 * (lane + (target - lane) * between(0, 1))
    desired = torch.maximum(between(10, 40), 0.9 * speed)
    return vehicles_at(x, target, y=y, speed=speed, desired_speed=desired)


Change = Callable[[Vehicles, Vehicles], Vehicles]


def course(
    traffic: TrafficModule,
    cars: Vehicles,
    steps: int,
    change: Change = lambda before, after: after,
) -> Iterator[tuple[Vehicles, TensorDictBase]]:
    """The cars of episodes 0 to N - 1 after each physics step, or what ``change`` makes of them,
    and the traffic's memory.
    """
    key = episode_keys(range(len(cars.x)))
    _, memory = traffic.enter(cars, key, torch.arange(len(key)))
    for step in range(steps):
        state = TensorDict(
            {
                keys.VEHICLES: cars.as_dict(),
                keys.TRAFFIC: memory,
                keys.EPISODE_KEY: key,
                keys.STEP: torch.full_like(key, step),
            },
            key.shape,
        )
        after = traffic(state)
        cars = change(cars, Vehicles.of(after[keys.MOVED]))
        memory = after[keys.TRAFFIC]
        yield cars, memory


def moves(*arguments: Any) -> Iterator[Vehicles]:
    """The cars of :func:`course`."""
    return (cars for cars, _ in course(*arguments))


def film_of(frames: Iterable[Vehicles]) -> Vehicles:
    """Frames [N, M] one after the other, [T, N, M]."""
    return Vehicles(*(torch.stack(fields) for fields in zip(*frames)))


def packed(spread_m: float, spacing_m: float) -> SpawnParameters:
    """Table II on another stretch.

    Where cars stand closer, they are no faster than what they can brake from.
    """
    table = SpawnParameters(spread_m=spread_m, min_spacing_m=spacing_m)
    top = 0.95 * (-2.0 * TABLE_V.min_acceleration * (spacing_m - table.length_m)) ** 0.5

    def slower(speeds: tuple[float, float]) -> tuple[float, float]:
        return min(speeds[0], 0.8 * top), min(speeds[1], top)

    names = ("front_speed_mps", "rear_speed_mps", "ego_speed_mps")
    return replace(table, **{name: slower(getattr(table, name)) for name in names})


def environment(
    lanes: int = 3,
    num_envs: int = 1,
    vehicles: int = 9,
    mobil: bool = True,
    period_s: float = 1.0,
    goal_m: float = 5000.0,
    timeout_s: float = 1000.0,
    abort: bool = False,
    visibility: Visibility = Visibility.BODY,
    spawn: SpawnParameters | None = None,
    traffic: TrafficModule | None = None,
    ring_m: float | None = None,
    stretches: Stretches = (),
    flow: FlowParameters | None = None,
    stream: int = Stream.TRAIN,
    **others: object,
) -> HighwayEnv:
    """A HighwayEnv in float64 unless told otherwise."""
    road = Road(lanes=lanes, ring_m=ring_m, stretches=stretches, flow=flow)
    traffic = traffic or (IdmMobilTraffic(road, stream) if mobil else IdmTraffic(road, stream))
    return HighwayEnv(
        traffic,
        num_envs=num_envs,
        vehicles=vehicles,
        spawn_parameters=spawn,
        ego=EgoParameters(abort_lane_change=abort, visibility=visibility.name.lower()),
        episode=EpisodeParameters(decision_period_s=period_s, goal_m=goal_m, timeout_s=timeout_s),
        **{"dtype": DOUBLE, **others},  # type: ignore[arg-type]
    )


def rules_of(env: HighwayEnv) -> scalar.Rules:
    """The scalar simulator's settings for the same run."""
    flow = env.road.flow
    if flow is not None:
        arrivals = flow.arrivals(env.road.stretches, env.episode.decision_period_s)
        flow = scalar.Flow(arrivals, flow.exit_share, flow.from_m, flow.to_m)
    return scalar.Rules(
        lanes=env.road.lanes,
        mobil=isinstance(env.traffic, IdmMobilTraffic),
        abort=env.ego.abort_lane_change,
        substeps=env.episode.substeps(),
        goal=env.episode.goal_m,
        timeout_steps=round(env.episode.timeout_s / 0.1),
        ring=env.road.ring_m,
        stretches=env.road.stretches,
        actions=env.actions.form,
        flow=flow,
    )


def placed(env: HighwayEnv, scene: Vehicles) -> TensorDictBase:
    """The state after a reset with the vehicles replaced by ``scene``."""
    td = env.reset()
    for name, value in scene.as_dict().items():
        td[keys.VEHICLES, name] = value.clone()
    return td


def step(
    env: HighwayEnv, td: TensorDictBase, action: int | Sequence[int] | torch.Tensor = 0
) -> TensorDictBase:
    """The state after one decision; ``td`` stays as it is."""
    td = td.clone()
    if env.actions.names:
        td["action"] = torch.as_tensor(action, dtype=torch.int64).expand(env.batch_size).clone()
    else:
        td["action"] = torch.as_tensor(action, dtype=torch.float64).expand(*env.batch_size, 2)
    return env.step(td)["next"]


def run(
    env: HighwayEnv,
    decisions: int,
    act: Callable[[TensorDictBase], Any] = lambda td: keys.KEEP,
    start: TensorDictBase | None = None,
) -> list[TensorDictBase]:
    """The first state, of a reset unless told otherwise, and those after each decision, without
    resets.
    """
    states = [env.reset() if start is None else start]
    for _ in range(decisions):
        states.append(step(env, states[-1], act(states[-1])))
    return states


def scalar_cars(scene: Vehicles, row: int) -> list[scalar.Car]:
    """One row of a scene, with straight wheels."""
    return [scalar.Car(*numbers) for numbers in zip(*(field[row].tolist() for field in scene))]


def scalar_state(td: TensorDictBase, row: int, env: HighwayEnv) -> scalar.State:
    """Row ``row`` of an environment's state as scalar cars."""
    cars = scalar_cars(Vehicles.of(td[keys.VEHICLES]), row)
    flow = env.road.flow
    for i, car in enumerate(cars):
        car.steering = td[keys.TRAFFIC, "steering"][row, i].item()
        car.exits = flow is not None and flow.exits(len(cars))[i]
    ego = {name: value[row].item() for name, value in td[keys.EGO].items()}
    cars[0].steering = ego["steering"]
    cars[0].exits = env.road.exit_lane is not None
    return scalar.State(
        cars,
        td[keys.STEP][row].item(),
        ego["change_direction"],
        ego["soft_crash"],
        ego["soft_crash_behind"],
        ego["lane_changes"],
        key=int(episode_key(env.stream, td[keys.SEED], td[keys.EPISODE])[row]),
        set_speed=ego.get("set_speed", 25.0),
    )


def leaves(td: TensorDictBase) -> Iterator[tuple[str | tuple[str, ...], torch.Tensor]]:
    """All tensors of a TensorDict with their keys, in a fixed order."""
    yield from sorted(
        td.items(include_nested=True, leaves_only=True), key=lambda item: str(item[0])
    )


def same_bits(one: TensorDictBase, other: TensorDictBase) -> list[str]:
    """Names of the entries that are missing in one or differ in any bit."""
    a = dict(leaves(one))
    b = dict(leaves(other))
    return [
        str(name)
        for name in {**a, **b}
        if name not in a or name not in b or not torch.equal(a[name], b[name])
    ]


def few_changes(td: TensorDictBase) -> torch.Tensor:
    """Commands that follow from episode and decision: in two of eleven a change of lanes."""
    number = (td[keys.EPISODE] * 7 + td[keys.EGO, "decisions"] * 5) % 11
    return torch.where(number < 3, number, keys.KEEP)


Track = list[torch.Tensor]


def tracks(
    env: HighwayEnv,
    decisions: int,
    act: Callable[[TensorDictBase], torch.Tensor],
    episodes: Sequence[int] | None = None,
) -> dict[int, Track]:
    """Episode to its states, over a run with automatic resets; unfinished episodes are left out.

    ``episodes`` [N] are those that it begins with; None: the environment's first ones. A state is
    all that there is of a row, exactly (a float32 and a small integer fit into a float64).
    """
    td = env.reset()
    if episodes is not None:
        td = env.reset(td.select(keys.SEED, keys.EPISODE).set(keys.EPISODE, torch.tensor(episodes)))
    episodes_of: dict[int, Track] = {}
    finished = set()
    for _ in range(decisions):
        stepped, td = env.step_and_maybe_reset(td.set("action", act(td)))
        after = stepped["next"].exclude("reward", "action")
        numbers = [
            value.reshape(len(after), -1).double()
            for name, value in leaves(after)
            if name != keys.EPISODE
        ]
        states = torch.cat(numbers, dim=1)
        for row, episode in enumerate(after[keys.EPISODE].tolist()):
            episodes_of.setdefault(episode, []).append(states[row])
            if after["done"][row]:
                finished.add(episode)
    return {episode: episodes_of[episode] for episode in finished}


def assert_same_tracks(some: dict[int, Track], others: dict[int, Track], at_least: int) -> None:
    """That so many episodes are in both, and the same bit for bit."""
    common = some.keys() & others.keys()
    assert len(common) >= at_least
    for episode in common:
        assert torch.equal(torch.stack(some[episode]), torch.stack(others[episode])), episode


def random_stretches(lanes: int, rng: random.Random) -> Stretches:
    """One lane goes on; each of the others may begin late and end at a wall, one at an exit."""
    going_on = rng.randrange(lanes)
    exit_lane = rng.randrange(2 * lanes)
    stretches = []
    for lane in range(lanes):
        if lane == going_on or (lane != exit_lane and rng.random() < 0.3):
            stretches.append(LaneStretch())
            continue
        begin_m = rng.choice([-FAR_M, rng.uniform(-150.0, 0.0)])
        # Some so near that an ego cannot stop.
        end_m = rng.choice([rng.uniform(5.0, 40.0), rng.uniform(60.0, 350.0)])
        stretches.append(LaneStretch(begin_m, end_m, EXIT if lane == exit_lane else WALL))
    return tuple(stretches)


#: Roads, and the forms of the ego's actions.
KINDS = [
    (road, form)
    for road in ("highway", "lanes that end", "flow")
    for form in ("lane", "lane_speed", "continuous")
]


def random_environment(
    rng: random.Random,
    rows: int,
    road: str = "highway",
    form: str = "lane",
    most_vehicles: int = 20,
    spacings_m: Sequence[float] = (8.0, 12.0, 25.0),
    lanes: int | None = None,
    **others: object,
) -> HighwayEnv:
    """Tensor code on 1 to 6 lanes with 2 to ``most_vehicles``, dense and sparse, in float32.

    All periods and visibilities, with and without MOBIL and drivers who crawl. On a ``road`` of
    "lanes that end" some begin late and end at a wall; where there is a "flow", vehicles enter and
    leave, too. ``form``: of the actions; ``others`` are arguments of :func:`environment`.
    """
    lanes = lanes or rng.randint(1, 6)
    vehicles = rng.randint(2, most_vehicles)
    spacing_m = rng.choice(spacings_m)
    spawn = packed(max(60.0, 1.5 * spacing_m * vehicles / lanes + spacing_m), spacing_m)
    if rng.random() < 0.3:
        crawl = rng.choice([1.0, 5.0]), rng.choice([8.0, 36.0])
        spawn = replace(spawn, desired_speed_mps=crawl)
    stretches = random_stretches(lanes, rng) if road != "highway" else ()
    options = {
        "lanes": lanes,
        "vehicles": vehicles,
        "spawn": spawn,
        "mobil": rng.random() < 0.75,
        "period_s": rng.choice([0.1, 0.3, 0.5, 1.0]),
        "goal_m": rng.choice([60.0, 5000.0]),
        "timeout_s": rng.choice([4.0, 1000.0]),
        "abort": rng.random() < 0.5,
        "visibility": rng.choice(list(Visibility)),
        "seed": rng.randrange(10**9),
        "recycle": rng.random() < 0.5 and not stretches,
        "stretches": stretches,
        "flow": random_flow(stretches, rng) if road == "flow" else None,
        "actions": ActionParameters(form),
        "dtype": torch.float32,
    }
    return environment(num_envs=rows, **{**options, **others})


def disturbed_start(env: HighwayEnv, generator: torch.Generator) -> TensorDictBase:
    """A first state with everything a little off.

    Some, egos among them, are in mid-change, at odd angles, with turned wheels, seen in all ways or
    not at all.
    """
    td = env.reset()
    start = Vehicles.of(td[keys.VEHICLES])
    between = drawing(start.x.shape, generator, env.dtype)
    side = (between(0, 1) < 0.3) * (between(0, 2).long() * 2 - 1)
    scene = start.with_(
        y=start.y + between(-0.5, 0.5) + 0.5 * side * between(0, 4),
        heading=between(-0.03, 0.03),
        speed=between(0, 30) * (between(0, 1) < 0.9),
        length=between(4, 6),
        width=between(1.8, 2.6),
        desired_speed=between(15, 35),
        target_lane=(start.target_lane + side).clamp(0, env.road.lanes - 1),
        visibility=between(0, 3).long(),
        valid=(between(0, 1) < 0.9) | start.is_ego(),
    )
    td[keys.VEHICLES].update(scene.as_dict())
    td[keys.EGO, "change_direction"] = (scene.target_lane - start.target_lane)[:, 0]
    wheels = between(-0.02, 0.02)
    td[keys.TRAFFIC, "steering"] = wheels
    td[keys.EGO, "steering"] = wheels[:, 0]
    return td


def random_actions(env: HighwayEnv, generator: torch.Generator) -> torch.Tensor:
    """Random actions [N], mostly to keep the lane."""
    if env.actions.form == "continuous":
        between = drawing(env.batch_size, generator, env.dtype)
        wheel = between(-0.4, 0.4) + between(-1, 1) * (between(0, 1) < 0.4)
        return torch.stack((between(-1.1, 1.1), wheel), dim=1)
    drawn = torch.rand(env.batch_size, generator=generator)
    if env.actions.form == "lane_speed" and bool(drawn[0] < 0.5):
        return torch.randint(3, 5, env.batch_size, generator=generator)
    changes = torch.where(drawn < 0.1, keys.LEFT, keys.RIGHT)
    return torch.where(drawn < 0.2, changes, keys.KEEP)


def random_flow(stretches: Stretches, rng: random.Random) -> FlowParameters:
    """Little and much of it, on a section on which the vehicles of a random scene stand."""
    ends = [its.end_m for its in stretches if its.end != NOTHING]
    return FlowParameters(
        vph=rng.choice([0.0, 400.0, 1800.0]),
        ramp_vph=rng.choice([0.0, 800.0]),
        exit_share=rng.choice([0.0, 0.3, 1.0]),
        from_m=rng.uniform(-250.0, -150.0),
        to_m=max([0.0, *ends]) + rng.uniform(1.0, 60.0),
    )
