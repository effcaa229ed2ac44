"""Counter-based randomness: every number is a pure function of its place of use.

A draw depends on (stream, seed, episode, vehicle, step, purpose) and on nothing else: not on the
batch, the row, the device or what was drawn before. Each field is mixed into a 64-bit key on its
own with the finaliser of splitmix64 (Steele et al. 2014), so no two fields can alias each other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum

import torch
from torch import Tensor

from ganlane.settings.episode import Stream as Stream  # also known as ganlane.sim.Stream
from ganlane.settings.record import Range
from ganlane.torch_settings import constant

# Constants of splitmix64; torch computes in signed integers.
_GOLDEN = -7046029254386353131  # 0x9E3779B97F4A7C15 as a signed 64-bit integer
_MIX_A = -4658895280553007687  # 0xBF58476D1CE4E5B9
_MIX_B = -7723592293110705685  # 0x94D049BB133111EB


class Purpose(IntEnum):
    """Use of a random number.

    Members are appended, never renumbered, since the number enters the hash.
    """

    SPAWN_LANE = 0
    SPAWN_POSITION = 1
    SPAWN_SPEED = 2
    SPAWN_DESIRED_SPEED = 3
    RANDOM_ACTION = 4
    LANE_CHANGE_HAZARD = 5
    LANE_CHANGE_SIDE = 6
    LANE_CHANGE_SPEED = 7
    ACCELERATION = 8
    TRAIT_HEADWAY = 9
    TRAIT_DESIRED_SPEED = 10
    FAULT = 11
    LATE_REACTION = 12
    HESITANT_CHANGE = 13
    ABORTED_CHANGE = 14
    REPLAY_START = 15
    NOISE = 16  # and the 47 purposes after it: the generator's latent vector, one per dimension
    RECYCLE = 64
    SENSED_POSITION = 65
    SENSED_LATERAL = 66
    SENSED_SPEED = 67
    SENSED_DROPOUT = 68
    BLIND_EPISODE = 69
    DRIVER = 70  # and the 15 purposes after it: per-driver parameters (traffic=idm_random)
    SPAWN_TRUCK = 90
    RECYCLED_EPISODE = 91
    FLOW_ARRIVAL = 92  # of each lane
    FLOW_EXIT = 93
    FLOW_SLOT = 94
    # and the 15 purposes after it: drivers of a foreign simulator, one per parameter
    FOREIGN_DRIVER = 128


def _shift(h: Tensor, bits: int) -> Tensor:
    """Logical right shift of int64."""
    # torch shifts the sign in from the left; it is masked away.
    return (h >> bits) & ((1 << (64 - bits)) - 1)


def _mix(h: Tensor) -> Tensor:
    """The finaliser of splitmix64.

    A bijection of 64 bits in which every input bit flips half the output.
    """
    h = (h ^ _shift(h, 30)) * _MIX_A
    h = (h ^ _shift(h, 27)) * _MIX_B
    return h ^ _shift(h, 31)


def absorb(key: Tensor, field: Tensor | int) -> Tensor:
    """Mix one more integer field into ``key`` (int64, broadcast)."""
    # Without the constant, 0 would stay 0.
    return _mix((key ^ field) + _GOLDEN)


def episode_key(stream: int, seed: Tensor, episode: Tensor) -> Tensor:
    """Key of an episode, [N] int64, from the stream and the counters [N] int64."""
    # The 0 after the stream stays: without it all episodes so far would change.
    start = torch.full_like(seed, int(stream))
    return absorb(absorb(absorb(start, 0), seed), episode)


def draw_keys(key: Tensor, step: Tensor | int, vehicles: int, purposes: Sequence[int]) -> Tensor:
    """Keys [N, vehicles, len(purposes)] from episode keys [N] and physics steps [N] or one int."""
    # Field by field, from what all share to what is one number's own.
    at_step = absorb(key, step)
    vehicle = torch.arange(vehicles, device=key.device)
    purpose = constant(purposes, key)
    return absorb(absorb(at_step[:, None], vehicle)[..., None], purpose)


def to_uniform(keys: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    """Uniform numbers in [0, 1), of the same shape as ``keys``, from their highest bits."""
    # As many bits as the mantissa holds: every number is exact, and 1 is never reached.
    bits = 53 if dtype == torch.float64 else 24
    return _shift(keys, 64 - bits).to(dtype) * 2.0**-bits


def uniform(
    key: Tensor,
    step: Tensor | int,
    vehicles: int,
    purposes: Sequence[int],
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Uniform numbers in [0, 1), [N, vehicles, len(purposes)]: a step's purposes in one call."""
    return to_uniform(draw_keys(key, step, vehicles, purposes), dtype)


def in_range(u: Tensor, bounds: Range) -> Tensor:
    """Uniform numbers in [0, 1) scaled to ``bounds``."""
    return bounds[0] + u * (bounds[1] - bounds[0])


def normal(
    key: Tensor,
    step: Tensor | int,
    vehicles: int,
    purposes: Sequence[int],
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Standard normal numbers, [N, vehicles, len(purposes)], by Box and Muller's transform.

    Independent of :func:`uniform` at the same place.
    """
    keys = draw_keys(key, step, vehicles, purposes)
    # 1 - u lies in (0, 1], so the logarithm is finite; a second key per number for the angle.
    radius = torch.sqrt(-2.0 * torch.log(1.0 - to_uniform(absorb(keys, 1), dtype)))
    return radius * torch.cos(2.0 * math.pi * to_uniform(absorb(keys, 2), dtype))
