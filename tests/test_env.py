"""The environment as its users meet it: specs, resets, commands, events and ends."""

import pytest
import torch
from reference.worlds import environment, few_changes, placed, run, same_bits, step, vehicles
from torchrl.envs.utils import check_env_specs

from ganlane import keys

KEEP = keys.KEEP
LEFT = keys.LEFT
RIGHT = keys.RIGHT
FAR = {"x": 2000.0, "lane": 0}


# Specs and seeds


@pytest.mark.parametrize(("mobil", "dtype"), [(True, torch.float32), (False, torch.float64)])
def test_the_environment_keeps_its_specs(mobil, dtype):
    check_env_specs(environment(num_envs=3, mobil=mobil, dtype=dtype))


def test_a_seed_gives_the_same_episodes_again_and_another_one_others():
    env = environment(num_envs=5, seed=3)
    first = env.reset()
    env.set_seed(4)
    other = env.reset()
    env.set_seed(3)
    assert same_bits(first, env.reset()) == []
    assert not torch.equal(first[keys.VEHICLES, "x"], other[keys.VEHICLES, "x"])


def test_row_i_starts_with_episode_first_plus_i():
    state = environment(num_envs=3, first_episode=2**40).reset()
    assert state[keys.EPISODE].tolist() == [2**40, 2**40 + 1, 2**40 + 2]


def test_after_a_reset_nothing_has_happened_yet():
    td = environment(num_envs=2).reset()
    assert td[keys.STEP].tolist() == [0, 0]
    for group in (keys.EVENTS, keys.EGO):
        assert all(not value.any() for value in td[group].values())
    assert not td["done"].any()


@pytest.mark.parametrize(("period", "substeps"), [(0.1, 1), (0.3, 3), (0.7, 7), (2.0, 20)])
def test_a_decision_is_a_whole_number_of_physics_steps(period, substeps):
    env = environment(period_s=period)
    assert step(env, env.reset())[keys.STEP].tolist() == [substeps]


# Resets


def test_a_partial_reset_leaves_the_other_rows_as_they_are_bit_for_bit():
    env = environment(num_envs=5, seed=9)
    *_, td = run(env, 3, few_changes)
    mask = torch.tensor([False, True, False, False, True])
    after = env.reset(td.clone().set("_reset", mask[:, None])).exclude("_reset", "reward")
    assert same_bits(after[~mask], td.exclude("reward")[~mask]) == []
    assert after[keys.EPISODE].tolist() == [0, 6, 2, 3, 9]
    whole = environment(num_envs=10, seed=9).reset()
    assert same_bits(after[mask], whole[torch.tensor([6, 9])]) == []


def test_a_reset_with_seed_and_episode_runs_exactly_those():
    env = environment(num_envs=3)
    td = env.reset().select(keys.SEED, keys.EPISODE)
    td[keys.SEED], td[keys.EPISODE] = torch.tensor([5, 0, 5]), torch.tensor([40, 2, 0])
    asked = env.reset(td)
    assert asked[keys.EPISODE].tolist() == [40, 2, 0]
    assert same_bits(asked[1:2], env.reset()[2:3]) == []
    assert same_bits(asked[2:3], environment(num_envs=1, seed=5).reset()) == []


# Ends

TO_GOAL = {"x": 999.0, "lane": 1, "speed": 20.0}


@pytest.mark.parametrize(
    ("ego", "others", "action", "reasons", "steps"),
    [
        # At 25 m/s, 2.5 m a step: 997.6, then 1000.1.
        ({"x": 995.1, "lane": 1, "speed": 25.0}, [FAR], KEEP, ["goal"], 2),
        # Within one step a hard crash comes before the goal: half a metre behind a standing car.
        (
            TO_GOAL,
            [{"x": x, "lane": 1, "speed": 0.0} for x in (1004.0, 1009.0)],
            KEEP,
            ["hard_crash"],
            1,
        ),
        # The goal reached a step before a crash counts.
        (TO_GOAL, [{"x": x, "lane": 1, "speed": 0.0} for x in (1006.5, 1011.5)], KEEP, ["goal"], 1),
        # A crash with a vehicle that is not valid is none.
        (
            {**TO_GOAL, "x": 0.0},
            [{"x": 10.0, "lane": 1, "speed": 0.0, "valid": False}],
            KEEP,
            [],
            10,
        ),
        ({"x": 0.0, "lane": 0}, [FAR], RIGHT, ["out_of_road"], 0),
        ({"x": 0.0, "lane": 2}, [FAR], LEFT, ["out_of_road"], 0),
    ],
)
def test_an_episode_ends_for_one_reason_at_the_step_of_it(ego, others, action, reasons, steps):
    env = environment(vehicles=1 + len(others), mobil=False, goal_m=1000.0)
    after = step(env, placed(env, vehicles(ego, *others)), action)
    assert [name for name in keys.END_EVENTS if after[keys.EVENTS, name]] == reasons
    assert after["terminated"] == after["done"] == bool(reasons)
    assert not after["truncated"]
    assert after[keys.STEP].item() == steps
    beyond_the_goal = after[keys.EGO, "distance"] > 1000.0
    assert beyond_the_goal == bool({"goal", "hard_crash"} & set(reasons))
