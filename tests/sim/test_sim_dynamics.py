"""Bicycle model and two-point steering."""

import math

import pytest
import torch
from reference.worlds import DOUBLE

from ganlane.sim.dynamics import WHEELBASE_M, advance, steer

ZERO = torch.zeros(1, dtype=DOUBLE)


def number(value):
    return torch.tensor([value], dtype=DOUBLE)


def drive(speed, steering, duration_s, acceleration=0.0):
    pose = (ZERO, ZERO, ZERO, number(speed))
    for _ in range(round(duration_s / 0.1)):
        pose = advance(*pose[:4], number(acceleration), number(steering), 0.1)
    return pose


def circle(speed, steering, duration_s):
    """Closed form: the centre of gravity runs on a circle of radius ``l_r / sin(beta)``."""
    beta = math.atan(0.5 * math.tan(steering))
    radius = 0.5 * WHEELBASE_M / math.sin(beta)
    turned = speed * duration_s / radius
    return (
        radius * (math.sin(beta + turned) - math.sin(beta)),
        radius * (math.cos(beta) - math.cos(beta + turned)),
        turned,
    )


@pytest.mark.parametrize(
    ("speed", "steering"), [(3.0, 0.5), (3.0, -0.5), (10.0, 0.1), (30.0, 0.01), (30.0, -0.002)]
)
def test_a_constant_steering_angle_drives_a_circle(speed, steering):
    x, y, heading = circle(speed, steering, 10.0)
    pose = drive(speed, steering, 10.0)
    assert pose.heading.item() == pytest.approx(heading, abs=1e-12)
    assert math.hypot(pose.x.item() - x, pose.y.item() - y) < 2e-3 * speed


def test_constant_acceleration_is_exact_and_braking_ends_at_rest():
    assert drive(0.0, 0.0, 10.0, acceleration=0.7).x.item() == pytest.approx(0.5 * 0.7 * 10.0**2)
    pose = drive(1.0, 0.0, 0.1, acceleration=-20.0)
    assert pose.speed.item() == 0.0
    assert pose.x.item() == pytest.approx(0.05)
    # what was realised, not what was asked for
    assert pose.acceleration.item() == pytest.approx(-10.0)


# Steering

SPEEDS = torch.linspace(3.0, 35.0, 65, dtype=DOUBLE)


def lane_change(speed, width):
    """Lateral positions [steps, speeds] in 30 s after the command to go ``width`` m to the left."""
    x = y = heading = wheel = torch.zeros_like(speed)
    track = []
    for _ in range(300):
        wheel = steer(wheel, y, heading, speed, torch.full_like(speed, width), 0.1)
        x, y, heading, _, _ = advance(x, y, heading, speed, torch.zeros_like(speed), wheel, 0.1)
        track.append(y)
    return torch.stack(track)


@pytest.mark.parametrize("width", [4.0, -4.0, 3.5])
def test_a_lane_change_takes_two_to_five_seconds_at_every_speed_without_overshoot(width):
    track = lane_change(SPEEDS, width)
    remaining = (track - width) * (1.0 if width > 0 else -1.0)
    arrival_s = ((remaining < -0.3).sum(0) + 1) * 0.1
    assert arrival_s.min() >= 2.0
    assert arrival_s.max() <= 5.0
    assert remaining.max() <= 0.05
    assert remaining[-1].abs().max() < 1e-3


@pytest.mark.parametrize(
    ("steering", "y", "heading", "speed", "expected"),
    [
        (0.0, -4.0, 0.0, 0.0, 0.0),  # a standing car does not turn its wheels
        (0.0, 0.0, 0.0, 20.0, 0.0),  # in the middle of its lane it goes straight on
        # 20 m/s, 1 m right of the centre, straight wheels: near point at 20 m, far point at 80 m.
        # Nothing turns yet, so only the integral counts: 2.7 / 20 * 3.375 * atan(1 / 20) * 0.1 =
        # 0.00227623 rad.
        (0.0, -1.0, 0.0, 20.0, 0.00227623),
        (0.45, -50.0, -1.0, 3.0, 0.5),  # at most half a radian
    ],
)
def test_steering_by_hand(steering, y, heading, speed, expected):
    turned = steer(*map(number, (steering, y, heading, speed)), ZERO, 0.1).item()
    assert turned == pytest.approx(expected, abs=1e-8)
