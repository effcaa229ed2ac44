"""The environment against the plain scalar simulator of ``tests/reference/scalar.py``."""

import random
from collections.abc import Sequence

import pytest
import torch
from reference import scalar
from reference.worlds import (
    DOUBLE,
    disturbed,
    environment,
    packed,
    placed,
    random_flow,
    random_stretches,
    rules_of,
    scalar_state,
    step,
)

from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.settings.actions import ActionParameters
from ganlane.settings.episode import SpawnParameters
from ganlane.sim.state import Vehicles

CLOSE = {"rel": 0.0, "abs": 1e-6}
MOTION = ("x", "y", "heading", "speed", "acceleration")


def random_environment(rng: random.Random, rows: int, road: str, actions: str) -> HighwayEnv:
    """1 to 6 lanes, 2 to 20 vehicles, sparse to dense, with and without MOBIL, all outcomes.

    On a ``road`` that is no highway some lanes begin late and end at a wall, with ``flow`` vehicles
    enter and leave.
    """
    lanes = rng.randint(1, 6)
    vehicles = rng.randint(2, 20)
    spacing = rng.choice([8.0, 12.0, 25.0])
    spread = max(60.0, 1.5 * spacing * vehicles / lanes + spacing)
    stretches = random_stretches(lanes, rng) if road != "highway" else ()
    return environment(
        lanes,
        rows,
        vehicles,
        mobil=rng.random() < 0.75,
        period_s=rng.choice([0.3, 0.5, 1.0, 1.0, 2.0]),
        goal_m=rng.choice([20.0, 60.0, 5000.0, 5000.0]),
        timeout_s=rng.choice([2.5, 1000.0, 1000.0]),
        abort=rng.random() < 0.3,
        spawn=packed(spread, spacing),
        seed=rng.randrange(10**9),
        stretches=stretches,
        flow=random_flow(stretches, rng) if road == "flow" else None,
        actions=ActionParameters(actions),
    )


def disturb(env: HighwayEnv, td, generator: torch.Generator):
    """A state in which the wheels are turned and some, the ego included, are in the middle of a
    change.
    """
    start = Vehicles.of(td[keys.VEHICLES])
    td = placed(env, disturbed(start, env.road.lanes, generator))
    td[keys.TRAFFIC, "steering"] = 0.02 * torch.randn(
        start.x.shape, dtype=DOUBLE, generator=generator
    )
    td[keys.EGO, "change_direction"] = (td[keys.VEHICLES, "target_lane"] - start.target_lane)[:, 0]
    return td


def any_action(rng: random.Random, state: scalar.State, lanes: int) -> int:
    return rng.choice((0, 0, 1, 2))


def any_speed(rng: random.Random, state: scalar.State, lanes: int) -> int:
    return rng.choice((0, 3, 3, 4, 4, 4, 1, 2) if rng.random() < 0.2 else (0, 3, 4))


def any_controls(rng: random.Random, state: scalar.State, lanes: int) -> tuple[float, float]:
    wheel = rng.choice((0.0, 0.0, 0.4, -0.4, 1.0, -1.0)) + rng.uniform(-0.1, 0.1)
    return rng.uniform(-0.6, 1.0), max(-1.0, min(1.0, wheel))


def stay_on_the_road(rng: random.Random, state: scalar.State, lanes: int) -> int:
    lane = state.cars[0].target_lane
    return rng.choice([0] * 20 + [1] * (lane < lanes - 1) + [2] * (lane > 0))


CHOICES = {"lane": any_action, "lane_speed": any_speed, "continuous": any_controls}


def compare(
    env: HighwayEnv, td, duration_s: float, rng: random.Random, choose=any_action
) -> set[str]:
    """Drive both simulators with the same random actions; compare states, events and memories.

    Which ends and soft crashes there were, and whether anybody entered or left.
    """
    rules = rules_of(env)
    rows = env.batch_size[0]
    seen = set()
    states = [scalar_state(td, row, env) for row in range(rows)]
    running = [True] * rows
    for _ in range(round(duration_s / env.episode.decision_period_s)):
        actions = [choose(rng, state, rules.lanes) for state in states]
        td = step(env, td, actions)
        for row in range(rows):
            if running[row]:
                before = [car.valid for car in states[row].cars]
                outcome = scalar.decide(states[row], actions[row], rules)
                pairs = zip(before, states[row].cars)
                seen |= {
                    "entered" if car.valid else "left" for was, car in pairs if was != car.valid
                }
                assert_same(td, row, states[row], outcome)
                seen |= {*outcome.reasons}
                seen |= {name for name in keys.EVENT_COUNTS if getattr(outcome, name)}
                running[row] = not outcome.reasons
        if not any(running):
            break
    return seen


def assert_same(td, row: int, state: scalar.State, outcome: scalar.Outcome) -> None:
    for name in (*MOTION, "target_lane", "valid"):
        expected = [getattr(car, name) for car in state.cars]
        assert td[keys.VEHICLES, name][row].tolist() == pytest.approx(expected, **CLOSE), name
    reasons = set(outcome.reasons)
    ego = {
        "started_change": outcome.started_change,
        "change_direction": state.direction,
        "lane_changes": state.lane_changes,
        "steering": state.cars[0].steering,
        "distance": state.cars[0].x,
        "mean_acceleration": outcome.mean_acceleration,
        "change_progress": outcome.progress,
    }
    expected = {
        keys.STEP: state.step,
        "terminated": not reasons.isdisjoint(keys.TERMINAL_EVENTS),
        "truncated": not reasons.isdisjoint(keys.TRUNCATING_EVENTS),
        "done": bool(reasons),
        **{(keys.EVENTS, name): name in reasons for name in keys.END_EVENTS},
        **{(keys.EVENTS, name): getattr(outcome, name) for name in keys.EVENT_COUNTS},
        **{(keys.EGO, name): value for name, value in ego.items()},
    }
    assert {key: td[key][row].item() for key in expected} == pytest.approx(expected, **CLOSE)


#: Roads, and what the ego chooses among.
KINDS = [(road, form) for road in ("highway", "lanes that end", "flow") for form in CHOICES]


def compare_random_scenes(
    kinds: Sequence[tuple[str, str]], roads: int, rows: int, duration_s: float
) -> set[str]:
    """On roads of all kinds in turn, ``rows`` scenes on each; what there was of events."""
    rng = random.Random(0)
    generator = torch.Generator().manual_seed(0)
    seen = set()
    for number in range(roads):
        road, form = kinds[number % len(kinds)]
        env = random_environment(rng, rows, road, form)
        td = env.reset()
        if number % 2:
            td = disturb(env, td, generator)
        seen |= compare(env, td, duration_s, rng, CHOICES[form])
    return seen


def test_the_tensor_code_agrees_with_the_scalar_one_on_random_scenes():
    seen = compare_random_scenes(KINDS, roads=18, rows=6, duration_s=4.0)
    # Recordings alone end with their scene.
    events = {*keys.END_EVENTS, *keys.EVENT_COUNTS} - {"scene_end"}
    assert seen == events | {"entered", "left"}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids="-".join)
def test_and_on_2000_of_each_kind(kind):
    compare_random_scenes([kind], roads=500, rows=4, duration_s=10.0)


def test_on_a_ring_they_agree_too():
    spawn = SpawnParameters(spread_m=170.0, min_spacing_m=20.0)
    env = environment(lanes=2, num_envs=3, vehicles=12, ring_m=200.0, spawn=spawn, seed=8)
    compare(env, env.reset(), duration_s=10.0, rng=random.Random(4), choose=stay_on_the_road)


@pytest.mark.parametrize(
    ("rows", "goal_m"), [(2, 150.0), pytest.param(15, 5000.0, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("mobil", [True, False])
def test_whole_episodes_agree_to_their_end(mobil, rows, goal_m):
    env = environment(num_envs=rows, mobil=mobil, goal_m=goal_m, first_episode=1000 * mobil)
    rng = random.Random(rows)
    seen = compare(env, env.reset(), duration_s=1000.0, rng=rng, choose=stay_on_the_road)
    assert "goal" in seen
