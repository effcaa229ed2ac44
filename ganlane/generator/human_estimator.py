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
#: Of the fit.
UPDATES, BATCH, RATE = 3000, 1024, 2e-3
#: Errors that weigh alike: speed, both accelerations, both lateral speeds, both places.
SCALES = (0.3, 0.8, 0.8, 0.1, 0.1, 0.05, 0.05)
#: Units of the observer along and across, m: of the motions, the forecast, and the differences.
OBSERVED_SCALE, FORECAST_SCALE, DIFFERENCE_SCALE = (0.1, 0.03), (0.3, 0.1), (0.1, 0.03)


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

        # The network corrects the mean speeds along and across.
        level = torch.zeros_like(out)
        level[..., 0] = mean[..., 0, 0]
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
        """Differences [..., 8, 2] in m; positions [..., 9, 2] and forecast [..., 8, 2] are relative
        to the last position.
        """
        # Displacements in 0.1 s and their mean, m.
        motion = positions.diff(dim=-2)
        mean = motion.mean(-2, keepdim=True)
        steps = torch.arange(1, PREDICTED_STEPS + 1, device=mean.device)[:, None]

        # What both have beyond a constant velocity.
        apart = (motion - mean) / motion.new_tensor(OBSERVED_SCALE)
        ahead = (forecast - steps * mean) / motion.new_tensor(FORECAST_SCALE)
        out = self.layers(torch.cat((apart.flatten(-2), ahead.flatten(-2)), -1))
        return out.unflatten(-1, (PREDICTED_STEPS, 2)) * motion.new_tensor(DIFFERENCE_SCALE)


class HumanModel(nn.Module):
    """What a file of ``human`` holds: the policy; estimator and observer for forecasts."""

    def __init__(self, sizes: HumanSizes) -> None:
        super().__init__()
        self.sizes = sizes
        self.policy = HumanPolicy(sizes)
        self.estimator = Estimator()
        self.observer = Observer()


def roughness(positions: Tensor) -> Tensor:
    """How much speeds jitter from step to step, m/s, along and across, [..., 2].

    The root mean square of the velocity's second difference, which a driver's motion has hardly.
    """
    motion = positions.diff(dim=-2) / PHYSICS_STEP_S
    return motion.diff(dim=-2).diff(dim=-2).square().mean(-2).sqrt()


def trust(positions: Tensor) -> Tensor:
    """How far a history [..., 9, 2] can be trusted, as the age of a driver in decisions, 1 to 5."""
    return 1.0 + 4.0 * torch.exp(-roughness(positions)[..., 0] / 0.15)


def present_memory(motion: Tensor, age: Tensor) -> Memory:
    """What drivers remember whose ``motion`` [N, M, 7] is the :class:`Estimator`'s.

    ``age`` [N, M]: for how many decisions they count as seen (:func:`trust`).
    """
    # Older accelerations than two decisions' are not known: 0.
    accelerations = pad(motion[..., 1:3], (0, ACCELERATIONS - 2))
    lateral_speeds = motion[..., 4:5].repeat(1, 1, LATERAL_SPEEDS)
    return memory_of(accelerations, lateral_speeds, age)


def fit_estimator(
    estimator: Estimator, scenes: Sequence[SmoothScene], random: torch.Generator
) -> None:
    """Fit the estimator to these scenes, which hold the recorded and the smoothed positions.

    What it is to find is the motion of the smoothed track, under none, some or all of the recorded
    noise. It needs no gradients afterwards.
    """
    raw, smooth, motion = _tracks(scenes)
    optimizer = torch.optim.Adam(estimator.parameters(), RATE)
    for update in range(UPDATES):
        optimizer.param_groups[0]["lr"] = RATE * half_cosine(update, UPDATES)

        # Positions [B, 9, 2] with a share of the recorded noise.
        rows = torch.randint(len(raw), (BATCH,), generator=random)
        noise = noise_shares(BATCH, 0.25, 0.65, random)
        positions = smooth[rows] + noise * (raw[rows] - smooth[rows])

        # The last two numbers are the error of the last position.
        wanted = motion[rows].clone()
        wanted[:, 5:] -= positions[:, -1]

        # Mirrored at random: positions across, both lateral speeds, the error across.
        side = random_sides(BATCH, random)
        positions = positions - positions[:, -1:]
        positions[..., 1] *= side
        wanted[:, [3, 4, 6]] *= side
        difference = estimator(positions.float()) - wanted.float()
        descend(optimizer, error_in(difference, SCALES))
    estimator.requires_grad_(False)


def noise_shares(rows: int, without: float, as_recorded: float, random: torch.Generator) -> Tensor:
    """Shares [rows, 1, 1] of the recorded noise: none, all, or a little more than that at most.

    ``without`` is the chance of none, ``as_recorded`` that of none or all.
    """
    share = 1.2 * torch.rand((rows, 1, 1), generator=random)
    draw = torch.rand((rows, 1, 1), generator=random)
    noisy = torch.where(draw < as_recorded, 1.0, share)
    return torch.where(draw < without, 0.0, noisy)


def random_sides(rows: int, random: torch.Generator) -> Tensor:
    """Signs [rows, 1] of numbers across the road: left and right are alike."""
    return torch.where(torch.rand((rows, 1), generator=random) < 0.5, -1.0, 1.0)


def error_in(difference: Tensor, scales: tuple[float, ...]) -> Tensor:
    """The mean smooth absolute error of a ``difference`` in units of ``scales``."""
    error = difference / torch.tensor(scales)
    return smooth_l1_loss(error, torch.zeros_like(error))


def _tracks(scenes: Sequence[SmoothScene]) -> tuple[Tensor, Tensor, Tensor]:
    """Nine recorded and smoothed positions [R, 9, 2], and the motion at the last one [R, 7].

    In float64, since places on the road are large numbers. The motion ends with the smoothed place
    itself; what an :class:`Estimator` is to find is how far an observed one is from it.
    """
    raw, smooth, motion = [], [], []
    for scene in scenes:
        for track in range(scene.x.shape[1]):
            rows = np.flatnonzero(scene.present[:, track])
            # Every 0.2 s.
            for last in range(rows[0] + OBSERVED_POSITIONS - 1, rows[-1] + 1, 2):
                nine = slice(last - OBSERVED_POSITIONS + 1, last + 1), track
                raw.append(np.stack((scene.raw_x[nine], scene.raw_y[nine]), -1))
                smooth.append(np.stack((scene.x[nine], scene.y[nine]), -1))

                # At the last position, and one and two decisions before it, newest first.
                speed = scene.speed[[last, last - STEPS, last - 2 * STEPS], track]
                aside = scene.lateral_speed[[last, last - STEPS], track]
                accelerations = -np.diff(speed) / DECISION_S
                place = (scene.x[last, track], scene.y[last, track])
                motion.append([speed[0], *accelerations, *aside, *place])
    return tuple(torch.tensor(np.array(numbers)) for numbers in (raw, smooth, motion))  # type: ignore[return-value]
