"""The fixed order by lane and role, on scenes made by hand and against a loop."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ganlane.sim import Road, Vehicles
from ganlane.transforms import ObservationTransform, observation_size
from ganlane.transforms.observation import places

EMPTY = [1.0, 0.0, 0.0]


def scene(rows, valid=None):
    """One environment from (x, lane, speed) per vehicle, the ego first."""
    x, lane, speed = (torch.tensor([column], dtype=torch.float64) for column in zip(*rows))
    zero = torch.zeros_like(x)
    flags = torch.ones_like(x, dtype=torch.bool) if valid is None else torch.tensor([valid])
    return Vehicles(
        x, lane * 4.0, zero, speed, zero, zero + 4.5, zero + 2.5, zero + 25.0, lane.long(), zero.long(), flags
    )


def observe(vehicles, lanes=3, form="fixed_order"):
    transform = ObservationTransform(Road(lanes), vehicles.x.shape[1], form)
    progress = torch.tensor([0.25], dtype=torch.float64)
    return transform.observe(vehicles, progress, torch.tensor([-1]), transform.road)[0]


def placed(vehicles, lanes=3):
    return observe(vehicles, lanes)[3:-2].reshape(-1, 3).tolist()


EGO = (0.0, 1, 20.0)


def test_every_role_has_its_place():
    rows = [
        EGO,
        (-20, 0, 14),
        (60, 1, 26),
        (-40, 1, 20),
        (30, 2, 20),
        (90, 2, 20),
        (80, 1, 20),
        (-10, 2, 20),
        (50, 0, 23),
    ]
    assert placed(scene(rows)) == [
        pytest.approx(place)
        for place in [
            [0.15, 0.0, 0.5],  # ahead: left, own, right
            [0.3, 0.2, 0.0],
            [0.25, 0.1, -0.5],
            [-0.05, 0.0, 0.5],  # behind
            [-0.2, 0.0, 0.0],
            [-0.1, -0.2, -0.5],
            [0.45, 0.0, 0.5],  # second ahead
            [0.4, 0.0, 0.0],
            EMPTY,
        ]
    ]


def test_own_state_comes_first_and_the_own_lane_change_last():
    values = observe(scene([EGO, (50, 1, 20)]))
    assert values[:3].tolist() == [0.8, 1.0, 1.0]
    assert values[-2:].tolist() == [0.25, -1.0]


def test_the_order_in_memory_does_not_matter():
    rows = [(60, 1, 26), (-40, 1, 20), (30, 2, 20), (90, 2, 20)]
    assert placed(scene([EGO, *rows])) == placed(scene([EGO, *reversed(rows)]))


def test_swapping_the_ranks_of_two_lanes_swaps_no_places():
    """What the list, nearest first, cannot say of itself."""
    near, far = (placed(scene([EGO, (x, 2, 20), (50, 1, 20)])) for x in (49, 51))
    assert near[1] == far[1]
    assert [a - b for a, b in zip(far[0], near[0])] == pytest.approx([0.01, 0.0, 0.0])


def test_a_vehicle_that_is_not_valid_and_one_two_lanes_away_have_no_place():
    rows = [(0.0, 0, 20.0), (10, 0, 20), (20, 0, 20), (30, 2, 20)]
    assert placed(scene(rows, valid=[True, False, True, True])) == [EMPTY, pytest.approx([0.1, 0.0, 0.0]), EMPTY]


def test_somebody_beside_the_ego_counts_as_behind():
    rows = [EGO, (0, 2, 20), (900, 2, 20), (900, 1, 20), (-900, 1, 20)]
    assert placed(scene(rows))[:4] == [[1.0, 0.0, 0.5], [1.0, 0.0, 0.0], EMPTY, [0.0, 0.0, 0.5]]


@pytest.mark.parametrize(("vehicles", "expected"), [(2, 3), (4, 3), (5, 6), (9, 9), (30, 30)])
def test_there_are_whole_groups_of_three_for_all_the_others(vehicles, expected):
    assert places(vehicles - 1) == expected
    assert observation_size("fixed_order", vehicles) == 3 + 3 * expected + 2


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 14), st.integers(1, 5), st.integers(0, 10_000))
def test_the_places_are_those_of_a_loop(others, lanes, seed):
    generator = torch.Generator().manual_seed(seed)
    x = 400.0 * torch.rand(others, generator=generator, dtype=torch.float64) - 200.0
    lane = torch.randint(0, lanes, (others + 1,), generator=generator).tolist()
    rows = [(0.0, lane[0], 20.0), *zip(x.tolist(), lane[1:], [22.0] * others)]
    expected = []
    for group in range(places(others) // 3):
        for side in (1, 0, -1):
            ahead = group % 2 == 0
            role = sorted(abs(a) for a, own, _ in rows[1:] if own - lane[0] == side and (a > 0) == ahead)
            distance = role[group // 2] / 200.0 if len(role) > group // 2 else None
            here = [distance if ahead else -distance, 2 / 30, side / max(lanes - 1, 1)] if distance else EMPTY
            expected.append(pytest.approx(here))
    assert placed(scene(rows), lanes) == expected
