"""A driver's present motion from its last nine positions, whatever noise is on them.

The :class:`Estimator` is a small network, fitted to pairs of recorded and smoothed tracks. The
:class:`Observer` is another one: what a recording will show besides the driver's motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad, smooth_l1_loss

from ganlane.generator.descent import descend, half_cosine
from ganlane.generator.human import (
    ACCELERATIONS,
    DECISION_S,
    LATERAL_SPEEDS,
    STEPS,
    HumanPolicy,
    Memory,
    layers,
    memory_of,
)
from ganlane.generator.windows import OBSERVED_POSITIONS, PREDICTED_STEPS
from ganlane.keys import PHYSICS_STEP_S
from ganlane.settings.generator import HumanSizes

if TYPE_CHECKING:
    from ganlane.generator.human_samples import SmoothScene

#: Width of the networks' layers.
HIDDEN = 64

# The fit of the estimator.
#: How many updates there are.
UPDATES = 3000
#: Drivers of an update.
BATCH = 1024
#: The highest learning rate.
RATE = 2e-3
#: Share of drivers with the noise of another sensor besides.
OTHER_SHARE = 0.4
#: Errors that weigh alike: speed, both accelerations, both lateral speeds, both places.
SCALES = (0.3, 0.8, 0.8, 0.1, 0.1, 0.05, 0.05)

# The noise of other sensors.
#: Its standard deviation along the road, from the least to the most, m.
OTHER_NOISE_M = (0.003, 0.5)
#: Across the road it is this share of that.
OTHER_ACROSS = 0.3
#: Its correlation from frame to frame at most.
OTHER_CORRELATION = 0.95

# Units of the observer, along and across, m.
#: Of the displacements in 0.1 s.
OBSERVED_SCALE = (0.1, 0.03)
#: Of the forecast positions.
FORECAST_SCALE = (0.3, 0.1)
#: Of the differences that it adds to them.
DIFFERENCE_SCALE = (0.1, 0.03)


class Estimator(nn.Module):
    """A driver's motion from nine positions, 0.1 s apart.

    Seven numbers: speed, m/s; acceleration over the last and the last but one 0.4 s, m/s2; lateral
    speed now and 0.4 s ago, m/s; and by how much the last position is wrong along and across, m.
    """

    def __init__(self) -> None:
        super().__init__()
        self.layers = layers(20, HIDDEN, HIDDEN, len(SCALES))

    def forward(self, positions: Tensor) -> Tensor:
        """The motion [..., 7] from positions [..., 9, 2] in m, wherever their origin is."""
        # Velocities [..., 8, 2] between the positions, m/s, and how they differ from their mean.
        motion = positions.diff(dim=-2) / PHYSICS_STEP_S
        mean = motion.mean(-2, keepdim=True)
        apart = motion - mean

        # 8 + 8 + 2 + 1 + 1 numbers of about the size of 1.
        inputs = [
            apart[..., 0],
            3.0 * apart[..., 1],
            torch.log(roughness(positions) + 0.02),
            mean[..., 0] / 15.0,
            mean[..., 1],
        ]
        out = self.layers(torch.cat(inputs, -1))
        scale = torch.tensor([1.0, 1.0, 1.0, 0.3, 0.3, 0.1, 0.1])

        # The network corrects the mean speeds along and across: an output of 0 is a driver at
        # constant velocity, whose last position is exact.
        level = torch.zeros_like(out)
        level[..., 0] = mean[..., 0, 0]
        # Both lateral speeds.
        level[..., 3:5] = mean[..., 0, 1:2]
        return level + scale * out


class Observer(nn.Module):
    """How recorded positions of the next 0.8 s differ from those that the policy forecasts.

    A camera's errors last for some tenths of a second, so nine positions show what the next ones
    will be. They are no driver's moves: traffic does without this network.
    """

    def __init__(self) -> None:
        super().__init__()
        inputs = OBSERVED_POSITIONS - 1 + PREDICTED_STEPS
        self.layers = layers(2 * inputs, HIDDEN, HIDDEN, 2 * PREDICTED_STEPS)

    def forward(self, positions: Tensor, forecast: Tensor) -> Tensor:
        """Differences [..., 8, 2] in m, recorded less forecast.

        Args:
            positions: the observed ones, relative to the last of them, [..., 9, 2] in m.
            forecast: the next positions, relative to the same point, [..., 8, 2] in m.
        """
        # Displacements in 0.1 s and their mean, m.
        motion = positions.diff(dim=-2)
        mean = motion.mean(-2, keepdim=True)
        steps = torch.arange(1, PREDICTED_STEPS + 1, device=mean.device)[:, None]

        # What both have beyond a constant velocity, [..., 8, 2], in units that make it about 1.
        apart = (motion - mean) / motion.new_tensor(OBSERVED_SCALE)
        ahead = (forecast - steps * mean) / motion.new_tensor(FORECAST_SCALE)

        inputs = torch.cat((apart.flatten(-2), ahead.flatten(-2)), -1)
        out = self.layers(inputs).unflatten(-1, (PREDICTED_STEPS, 2))
        return out * motion.new_tensor(DIFFERENCE_SCALE)


class HumanModel(nn.Module):
    """What a file of ``human`` holds: the policy; estimator and observer for forecasts.

    Attributes:
        sizes: of the policy; those of the two other networks are constants.
        policy: how drivers move and change lanes.
        estimator: how they move at the present, from nine positions.
        observer: what a recording will show besides.
    """

    def __init__(self, sizes: HumanSizes) -> None:
        super().__init__()
        self.sizes = sizes
        self.policy = HumanPolicy(sizes)
        self.estimator = Estimator()
        self.observer = Observer()


def roughness(positions: Tensor) -> Tensor:
    """How much speeds jitter from step to step, m/s, along and across, [..., 2].

    The root mean square of the velocity's second difference, which a driver's motion has hardly.
    ``positions`` are [..., 9, 2] in m.
    """
    motion = positions.diff(dim=-2) / PHYSICS_STEP_S
    jitter = motion.diff(dim=-2).diff(dim=-2)
    return jitter.square().mean(-2).sqrt()


def trust(positions: Tensor) -> Tensor:
    """How far a history [..., 9, 2] can be trusted, as the age of a driver in decisions, 1 to 5.

    The age tells the policy what a driver's memory is worth.
    """
    along = roughness(positions)[..., 0]
    return 1.0 + 4.0 * torch.exp(-along / 0.15)


def present_memory(motion: Tensor, age: Tensor) -> Memory:
    """What drivers remember whose motion is an estimate.

    Args:
        motion: the :class:`Estimator`'s, [N, M, 7].
        age: for how many decisions drivers count as seen (:func:`trust`), [N, M].
    """
    # Older accelerations than two decisions' are not known: 0.
    accelerations = pad(motion[..., 1:3], (0, ACCELERATIONS - 2))
    # The one of 0.4 s ago stands for all before the present.
    lateral_speeds = motion[..., 4:5].repeat(1, 1, LATERAL_SPEEDS)
    return memory_of(accelerations, lateral_speeds, age)


def fit_estimator(
    estimator: Estimator,
    scenes: Sequence[SmoothScene],
    faster_mps: float,
    random: torch.Generator,
) -> None:
    """Fit the estimator to these scenes, which hold the recorded and the smoothed positions.

    What it is to find is the motion of the smoothed track, under none, some or all of the recorded
    noise, and in part of the rows that of other sensors besides. It needs no gradients afterwards.

    Args:
        estimator: it is changed in place.
        scenes: recordings, smoothed.
        faster_mps: drivers are faster than recorded by up to this much, m/s.
        random: draws drivers, their noise, speeds and sides.
    """
    raw, smooth, motion = _tracks(scenes)
    optimizer = torch.optim.Adam(estimator.parameters(), RATE)
    for update in range(UPDATES):
        optimizer.param_groups[0]["lr"] = RATE * half_cosine(update, UPDATES)

        # Positions [B, 9, 2] with a share of the recorded noise: none of it in a quarter of the
        # rows, all of it in 0.4 of them.
        rows = torch.randint(len(raw), (BATCH,), generator=random)
        share = noise_shares(BATCH, 0.25, 0.65, random)
        positions = smooth[rows] + share * (raw[rows] - smooth[rows])

        # On other roads sensors and speeds are others.
        other = torch.rand((BATCH, 1, 1), generator=random) < OTHER_SHARE
        noise = other_noise(BATCH, OBSERVED_POSITIONS, random)
        positions = positions + torch.where(other, noise, 0.0)
        faster = faster_mps * torch.rand((BATCH, 1), generator=random)
        positions[..., 0] += faster * (PHYSICS_STEP_S * torch.arange(1 - OBSERVED_POSITIONS, 1))

        # The last two numbers are the error of the last position.
        wanted = motion[rows].clone()
        wanted[:, :1] += faster
        wanted[:, 5:] -= positions[:, -1]

        # Near 0, where float32 is exact, and mirrored at random: positions across, both lateral
        # speeds, the error across.
        side = random_sides(BATCH, random)
        positions = positions - positions[:, -1:]
        positions[..., 1] *= side
        wanted[:, [3, 4, 6]] *= side

        difference = estimator(positions.float()) - wanted.float()
        descend(optimizer, error_in(difference, SCALES))
    estimator.requires_grad_(False)


def other_noise(tracks: int, frames: int, random: torch.Generator) -> Tensor:
    """Noise of other sensors on positions, m, [tracks, frames, 2].

    Tracks differ in its size, and in how long an error lasts: an autoregression of first order.
    """
    low, high = OTHER_NOISE_M
    size = low * (high / low) ** torch.rand((tracks, 1, 1), generator=random)

    # Of variance 1 in every frame, whatever the correlation.
    correlation = OTHER_CORRELATION * torch.rand((tracks, 1), generator=random)
    fresh_share = torch.sqrt(1.0 - correlation * correlation)
    errors = [torch.randn((tracks, 2), generator=random)]
    while len(errors) < frames:
        fresh = torch.randn((tracks, 2), generator=random)
        errors.append(correlation * errors[-1] + fresh_share * fresh)
    return size * torch.tensor([1.0, OTHER_ACROSS]) * torch.stack(errors, 1)


def noise_shares(
    rows: int,
    without: float,
    as_recorded: float,
    random: torch.Generator,
) -> Tensor:
    """Shares [rows, 1, 1] of the recorded noise, from 0 to 1.2.

    Args:
        rows: how many shares.
        without: chance of no noise at all.
        as_recorded: chance of none or of all of it; else the share is drawn evenly.
        random: draws them.
    """
    even = 1.2 * torch.rand((rows, 1, 1), generator=random)
    # One number decides between the three cases.
    draw = torch.rand((rows, 1, 1), generator=random)
    noisy = torch.where(draw < as_recorded, 1.0, even)
    return torch.where(draw < without, 0.0, noisy)


def random_sides(rows: int, random: torch.Generator) -> Tensor:
    """Signs [rows, 1] of numbers across the road: left and right are alike."""
    mirrored = torch.rand((rows, 1), generator=random) < 0.5
    return torch.where(mirrored, -1.0, 1.0)


def error_in(difference: Tensor, scales: tuple[float, ...]) -> Tensor:
    """The mean smooth absolute error of a ``difference`` [..., K] in units of K ``scales``."""
    error = difference / torch.tensor(scales)
    return smooth_l1_loss(error, torch.zeros_like(error))


def _tracks(scenes: Sequence[SmoothScene]) -> tuple[Tensor, Tensor, Tensor]:
    """What the estimator is fitted to, of all drivers every 0.2 s; float64, since places on the
    road are large numbers.

    Returns:
        Nine recorded and nine smoothed positions, [R, 9, 2] in m, and the motion at the last one,
        [R, 7]. The motion ends with the smoothed place itself; what an :class:`Estimator` is to
        find is how far an observed one is from it.
    """
    raw = []
    smooth = []
    motion = []
    for scene in scenes:
        for track in range(scene.x.shape[1]):
            rows = np.flatnonzero(scene.present[:, track])
            # Every 0.2 s, from the ninth position on.
            first = rows[0] + OBSERVED_POSITIONS - 1
            for last in range(first, rows[-1] + 1, 2):
                # The frames of one driver.
                nine = slice(last - OBSERVED_POSITIONS + 1, last + 1), track
                raw.append(np.stack((scene.raw_x[nine], scene.raw_y[nine]), -1))
                smooth.append(np.stack((scene.x[nine], scene.y[nine]), -1))

                # At the last position, and one and two decisions before it, newest first.
                speed = scene.speed[[last, last - STEPS, last - 2 * STEPS], track]
                accelerations = -np.diff(speed) / DECISION_S
                aside = scene.lateral_speed[[last, last - STEPS], track]
                place = (scene.x[last, track], scene.y[last, track])
                motion.append([speed[0], *accelerations, *aside, *place])

    return (
        torch.tensor(np.array(raw)),
        torch.tensor(np.array(smooth)),
        torch.tensor(np.array(motion)),
    )
