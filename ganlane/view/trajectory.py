"""A recorded episode: what every vehicle did, frame by frame, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from ganlane import keys
from ganlane.errors import UserError
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.state import Vehicles

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

ACTION_NAMES = ("keep", "left", "right")
#: A vehicle that moves further than this between two frames was recycled (placed elsewhere), m.
JUMP_M = 30.0


@dataclass(frozen=True)
class EpisodeLabel:
    """Agent, traffic, road and numbers of an episode."""

    agent: str = "ego"
    traffic: str = "traffic"
    seed: int = 0
    episode: int = 0
    #: Number of lanes; lane 0 is the rightmost.
    lanes: int = 3
    lane_width_m: float = 4.0


@dataclass(frozen=True)
class Trajectory:
    """T frames of M vehicles; the ego has index 0.

    Frame 0 is the state after the reset. SI units: positions of the bodies' centres in m, ``x`` along the
    road, ``y`` to the left; ``heading`` in rad, anticlockwise.
    """

    label: EpisodeLabel
    #: Time since the reset, s, [T].
    time_s: FloatArray
    #: Fields of ``vehicles`` (:mod:`ganlane.keys`), each [T, M].
    x: FloatArray
    y: FloatArray
    heading: FloatArray
    speed: FloatArray
    acceleration: FloatArray
    length: FloatArray
    width: FloatArray
    target_lane: IntArray
    valid: BoolArray
    #: Action of the decision that a frame belongs to, [T]; -1 before the first decision.
    action: IntArray
    #: Return up to the decision before, [T]; the last frame has the whole return.
    returns: FloatArray
    #: End event, one of :data:`ganlane.keys.END_EVENTS`; empty where the episode was cut off.
    outcome: str = ""
    #: Action values of the policy, [T, A]; NaN before the first decision, empty if unknown.
    action_values: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    #: Reward of the decision that a frame belongs to, [T]; NaN before the first, empty if unknown.
    reward: FloatArray = field(default_factory=lambda: np.empty(0))
    #: Jerk, m/s3, [T, M], where frames before these were left out (:meth:`since`); empty otherwise.
    driven_jerk: FloatArray = field(default_factory=lambda: np.empty((0, 0)))

    #: Ends of the decisions with a soft crash, s; empty if unknown.
    soft_crash_s: FloatArray = field(default_factory=lambda: np.empty(0))

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def vehicles(self) -> int:
        """Number of vehicles M, the ego included."""
        return self.x.shape[1]

    @property
    def frame_s(self) -> float:
        """Time between two frames, s."""
        return float(np.median(np.diff(self.time_s))) if len(self) > 1 else keys.PHYSICS_STEP_S

    def lane(self) -> IntArray:
        """Lane whose centre is nearest, [T, M]."""
        nearest = np.rint(self.y / self.label.lane_width_m).astype(np.int64)
        return nearest.clip(0, self.label.lanes - 1)

    def jumped(self) -> BoolArray:
        """Whether a vehicle was recycled (placed elsewhere) since the frame before, [T, M]."""
        moved = np.abs(np.diff(self.x, axis=0, prepend=self.x[:1]))
        return moved > JUMP_M * max(1.0, self.frame_s)

    def jerk(self) -> FloatArray:
        """Change of the acceleration since the frame before, m/s3, [T, M].

        0 in the episode's first two frames and after a jump.
        """
        if self.driven_jerk.size:
            return self.driven_jerk
        change = np.diff(self.acceleration, axis=0, prepend=self.acceleration[:1]) / self.frame_s
        begins = np.arange(len(self))[:, None] < 2
        return np.where(begins | self.jumped(), 0.0, change)

    def comfort(self) -> dict[str, float]:
        """The ego's ``rms_acceleration`` and ``hardest_braking`` (0 or below), m/s2, and ``rms_jerk``, m/s3."""
        acceleration, jerk = self.acceleration[:, 0], self.jerk()[:, 0]
        return {
            "rms_acceleration": round(float(np.sqrt(np.mean(acceleration**2))), 3),
            "rms_jerk": round(float(np.sqrt(np.mean(jerk**2))), 3),
            "hardest_braking": round(min(0.0, float(acceleration.min())), 3),
        }

    def since(self, start_s: float) -> Trajectory:
        """The frames from ``start_s`` on.

        Raises:
            UserError: the episode is over by then.
        """
        first = int(np.searchsorted(self.time_s, start_s - 1e-9))
        if first == len(self):
            raise UserError(f"start at {start_s:g} s: the episode lasts {self.time_s[-1]:g} s; choose a part of it.")
        arrays = {each.name: getattr(self, each.name) for each in fields(self)} | {"driven_jerk": self.jerk()}
        later: dict[str, Any] = {
            name: value[first:]
            for name, value in arrays.items()
            if isinstance(value, np.ndarray) and value.size and name != "soft_crash_s"
        }
        return replace(self, **later)

    def overlapping(self) -> BoolArray:
        """Whether a vehicle's box overlaps another's, [T, M]."""
        fields = {name: torch.as_tensor(getattr(self, name)) for name in ("x", "y", "heading", "length", "width")}
        unused = torch.zeros_like(fields["x"])
        others = {name: unused for name in keys.VEHICLE_FIELDS if name not in fields}
        everybody = Vehicles(**{**others, **fields, "valid": torch.as_tensor(self.valid)})
        return pair_overlaps(everybody).any(-1).numpy()
