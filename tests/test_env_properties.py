"""What holds in every environment, whatever the configuration, the scene and the actions."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import scalar
from reference.worlds import environment, rules_of, scalar_state, step

from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.sim.lanes import Visibility
from ganlane.sim.spawn import SpawnParameters
from ganlane.sim.vehicles import Vehicles

FIXED = ("length", "width", "desired_speed", "visibility", "valid")


@st.composite
def environments(draw, rows: int) -> HighwayEnv:
    lanes = draw(st.integers(1, 6))
    spacing = draw(st.sampled_from([5.0, 7.0, 12.0, 25.0]))
    vehicles = draw(st.integers(2, min(15, 3 * lanes)))
    return environment(
        lanes,
        rows,
        vehicles,
        mobil=draw(st.booleans()),
        period_s=draw(st.sampled_from([0.1, 0.3, 1.0, 2.0])),
        goal_m=draw(st.sampled_from([20.0, 60.0, 5000.0])),
        timeout_s=draw(st.sampled_from([2.5, 1000.0])),
        abort=draw(st.booleans()),
        visibility=draw(st.sampled_from(Visibility)),
        spawn=SpawnParameters(spread_m=max(10.0, 3.0 * spacing), min_spacing_m=spacing),
        seed=draw(st.integers(0, 2**40)),
    )


def actions(rows: int, decisions: int) -> st.SearchStrategy:
    row = st.lists(st.integers(0, 2), min_size=rows, max_size=rows)
    return st.lists(row, min_size=decisions, max_size=decisions)


class Film:
    """Every physics step of a decision: the vehicles before and after it, and who was running."""

    def __init__(self, env: HighwayEnv) -> None:
        self.frames: list[tuple[Vehicles, torch.Tensor]] = []
        env.recorder = lambda vehicles, running: self.frames.append((vehicles, running))


@settings(max_examples=25)
@given(env=environments(rows=3), plan=actions(3, 4))
def test_nobody_goes_faster_than_its_speed_or_backwards_and_sizes_never_change(env, plan):
    film, td = Film(env), env.reset()
    before = start = Vehicles.of(td[keys.VEHICLES])
    for action in plan:
        td = step(env, td, action)
    for after, _ in film.frames:
        moved = torch.hypot(after.x - before.x, after.y - before.y)
        assert (after.speed >= 0.0).all()
        assert (moved <= torch.maximum(before.speed, after.speed) * keys.PHYSICS_STEP_S + 1e-9).all()
        assert ((after.target_lane >= 0) & (after.target_lane < env.road.lanes)).all()
        assert ((after.target_lane - before.target_lane).abs() <= 1).all()
        for name in FIXED:
            assert torch.equal(getattr(after, name), getattr(start, name))
        before = after


@settings(max_examples=40)
@given(env=environments(rows=3), plan=actions(3, 5))
def test_every_flag_equals_its_recomputation_from_the_film(env, plan):
    """Frame by frame with the scalar boxes, gaps and times; exactly one reason where an episode ends."""
    td = env.reset()
    for action in plan:
        before = td
        td = step(env, td, action)
        film = Film(env)
        assert torch.equal(step(env, before, action)[keys.VEHICLES, "x"], td[keys.VEHICLES, "x"])
        env.recorder = None
        for row in range(3):
            check_row(env, before, action[row], td, film, row)
        done = td["done"][:, 0]
        ended = sum(td[keys.EVENTS, name].long() for name in keys.END_EVENTS)[:, 0]
        assert torch.equal(ended, done.long())
        if done.any():
            break


def check_row(env: HighwayEnv, before, action: int, after, film: Film, row: int) -> None:
    rules = rules_of(env)
    state = scalar_state(before, row)
    expected = {name: False for name in keys.END_EVENTS}
    ahead, behind = state.close_ahead, state.close_behind
    onsets = onsets_behind = 0
    step_count = state.step
    lane = state.cars[0].target_lane + (0, 1, -1)[action]
    turned = rules.abort and action and (1 if action == 1 else -1) == -state.direction
    expected["out_of_road"] = (state.direction == 0 or turned) and not 0 <= lane < rules.lanes
    for vehicles, running in film.frames:
        assert bool(running[row]) == (not any(expected.values()))
        if any(expected.values()):
            continue
        step_count += 1
        cars = cars_of(vehicles, row)
        now_ahead, now_behind = scalar.ego_close(scalar.View(cars, rules))
        onsets += now_ahead and not ahead
        onsets_behind += now_behind and not behind
        ahead, behind = now_ahead, now_behind
        crash = any(scalar.overlap(cars[0], car) for car in cars[1:])
        goal = cars[0].x >= rules.goal and not crash
        expected["hard_crash"], expected["goal"] = crash, goal
        expected["timeout"] = step_count >= rules.timeout_steps and not crash and not goal
    assert {name: after[keys.EVENTS, name][row].item() for name in expected} == expected
    assert after[keys.EVENTS, keys.SOFT_CRASH][row].item() == onsets
    assert after[keys.EVENTS, keys.SOFT_CRASH_BEHIND][row].item() == onsets_behind
    terminated = any(expected[name] for name in keys.TERMINAL_EVENTS)
    truncated = any(expected[name] for name in keys.TRUNCATING_EVENTS)
    assert after["terminated"][row].item() == terminated
    assert after["truncated"][row].item() == truncated
    assert after["done"][row].item() == (terminated or truncated)


def cars_of(vehicles: Vehicles, row: int) -> list[scalar.Car]:
    fields = {name: value[row].tolist() for name, value in vehicles.as_dict().items()}
    return [scalar.Car(**{name: value[i] for name, value in fields.items()}) for i in range(len(fields["x"]))]


@settings(max_examples=15)
@given(env=environments(rows=2), plan=actions(2, 3))
def test_every_state_lies_in_its_spec(env, plan):
    td = env.reset()
    for action in plan:
        td = step(env, td, action)
        assert env.observation_spec.contains(td.select(*env.observation_spec.keys()))
        assert all(torch.isfinite(td[keys.VEHICLES, name]).all() for name in keys.VEHICLE_FLOATS)
