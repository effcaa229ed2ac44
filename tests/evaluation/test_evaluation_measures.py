"""How a crash came about, and how near to one an episode was."""

import pytest
import torch
from reference.worlds import vehicles
from tensordict import TensorDict

from ganlane import keys
from ganlane.evaluation.measures import CHANGE_S, crash_kinds, first_marks, marks_after
from ganlane.sim import Road

ROAD = Road(lanes=3, lane_width_m=4.0)


def scene(*others, y=0.0, target=0):
    """The ego at x = 0 and 20 m/s, and others as (x, y, speed), all 4 m long and 2 m wide."""
    cars = [{"y": y, "target_lane": target}]
    for x, side, speed in others:
        cars.append({"x": x, "y": side, "speed": speed, "target_lane": round(side / 4.0)})
    return vehicles(*({"length": 4.0, "width": 2.0, **car} for car in cars), dtype=torch.float32)


@pytest.mark.parametrize(
    ("vehicles", "since_s", "kind"),
    [
        (scene((3.5, 0.0, 10.0)), 100.0, "run_into"),
        (scene((-3.5, 0.0, 30.0)), 100.0, "sitting"),
        (scene((-3.5, 4.0, 30.0), y=3.0, target=1), 2.0, "cut_in"),
        (scene((-3.5, 0.0, 30.0), y=1.0, target=1), 2.0, "leaving"),
        (scene((-3.5, 4.0, 30.0), y=4.0, target=1), CHANGE_S + 0.1, "sitting"),
    ],
)
def test_a_crash_is_of_the_kind_that_it_came_about(vehicles, since_s, kind):
    assert crash_kinds(vehicles, torch.tensor([since_s]), ROAD) == [kind]


def after(vehicles, marks, braking=0.0, started=False, step=10):
    ego = {
        "mean_acceleration": torch.tensor([braking]),
        "started_change": torch.tensor([started]),
    }
    state = {keys.VEHICLES: vehicles.as_dict(), keys.EGO: ego, keys.STEP: torch.tensor([step])}
    return marks_after(TensorDict(state, [1]), marks, ROAD)


def test_the_smallest_of_an_episode_is_marked():
    marks = first_marks(torch.ones(1))
    # 24 m between the centres are a gap of 20 m, closed at 10 m/s.
    marks = after(scene((24.0, 0.0, 10.0)), marks, braking=-1.0)
    marks = after(scene((44.0, 0.0, 25.0)), marks, braking=-3.0, started=True, step=20)
    marks = after(scene((14.0, 4.0, 0.0)), marks, braking=0.5, step=30)
    expected = {
        "least_ttc_s": 2.0,
        "least_headway_s": 1.0,
        "hardest_braking_mps2": -3.0,
        "change_s": 2.0,
    }
    assert {name: marks[name].item() for name in expected} == pytest.approx(expected)


def test_alone_on_the_road_nothing_is_near():
    marks = after(scene((-50.0, 0.0, 30.0)), first_marks(torch.ones(1)))
    assert marks["least_ttc_s"].item() > 100.0
    assert marks["hardest_braking_mps2"].item() == 0.0
