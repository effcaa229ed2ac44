"""The environment against the plain scalar simulator of ``tests/reference/scalar.py``."""

import random
from collections.abc import Sequence

import pytest
import torch
from reference import scalar
from reference.marks import slow
from reference.worlds import (
    KINDS,
    disturbed_start,
    environment,
    random_actions,
    random_environment,
    rules_of,
    scalar_state,
    step,
)

from ganlane import keys
from ganlane.agents.drivers import MobilDriver
from ganlane.env import HighwayEnv
from ganlane.settings.episode import SpawnParameters

CLOSE = {"rel": 0.0, "abs": 1e-6}
MOTION = ("x", "y", "heading", "speed", "acceleration")


def compare(env: HighwayEnv, td, duration_s: float, act) -> set[str]:
    """Drive both simulators with the actions ``act(td)``; compare states, events and memories.

    Which ends and soft crashes there were, and whether anybody entered or left.
    """
    rules = rules_of(env)
    rows = env.batch_size[0]
    seen = set()
    states = [scalar_state(td, row, env) for row in range(rows)]
    running = [True] * rows
    for _ in range(round(duration_s / env.episode.decision_period_s)):
        actions = act(td)
        td = step(env, td, actions)
        for row in range(rows):
            if running[row]:
                before = [car.valid for car in states[row].cars]
                outcome = scalar.decide(states[row], actions[row].tolist(), rules)
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


def compare_random_scenes(
    kinds: Sequence[tuple[str, str]], roads: int, rows: int, duration_s: float
) -> set[str]:
    """On roads of all kinds in turn, ``rows`` scenes on each; what there was of events."""
    rng = random.Random(0)
    generator = torch.Generator().manual_seed(0)
    seen = set()
    for number in range(roads):
        road, form = kinds[number % len(kinds)]
        env = random_environment(rng, rows, road, form, dtype=torch.float64, recycle=False)
        td = disturbed_start(env, generator) if number % 2 else env.reset()
        seen |= compare(env, td, duration_s, lambda td, env=env: random_actions(env, generator))
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


def by_mobil(env: HighwayEnv):
    """Changes lanes where it is of use, and stays on the road."""
    driver = MobilDriver(env.road)
    return lambda td: driver(td)["action"]


def test_on_a_ring_they_agree_too():
    spawn = SpawnParameters(spread_m=170.0, min_spacing_m=20.0)
    env = environment(lanes=2, num_envs=3, vehicles=12, ring_m=200.0, spawn=spawn, seed=8)
    compare(env, env.reset(), duration_s=10.0, act=by_mobil(env))


@pytest.mark.parametrize(("rows", "goal_m"), [(2, 150.0), slow(15, 5000.0)])
@pytest.mark.parametrize("mobil", [True, False])
def test_whole_episodes_agree_to_their_end(mobil, rows, goal_m):
    env = environment(num_envs=rows, mobil=mobil, goal_m=goal_m, first_episode=1000 * mobil)
    assert "goal" in compare(env, env.reset(), duration_s=1000.0, act=by_mobil(env))
