"""One decision of rule-driven traffic by the native kernel: tensors in, tensors out."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ganlane.errors import UserError
from ganlane.native.calls import addresses, in_threads
from ganlane.native.library import load
from ganlane.native.settings import settings_of
from ganlane.parameters.driving import EgoParameters, IdmParameters, MobilParameters, SteeringParameters
from ganlane.parameters.episode import EpisodeParameters
from ganlane.sim.dynamics import STEERING
from ganlane.sim.state import Road, Vehicles


class EgoState(NamedTuple):
    """What is remembered of the ego from one decision to the next, each [N]; see :mod:`ganlane.env.state`."""

    steering: Tensor
    change_direction: Tensor
    decisions: Tensor
    lane_changes: Tensor
    soft_crash: Tensor
    soft_crash_behind: Tensor


class Outcome(NamedTuple):
    """What a decision led to, in the order of the kernel's ``Outputs``; dtypes in :data:`OUTCOME`.

    The vehicles' fields and the traffic's ``steering`` are [N, M], ``step`` and the ego's memory [N], events and done
    flags [N, 1].
    """

    x: Tensor
    y: Tensor
    heading: Tensor
    speed: Tensor
    acceleration: Tensor
    target_lane: Tensor
    steering: Tensor
    ego_steering: Tensor
    mean_acceleration: Tensor
    change_progress: Tensor
    distance: Tensor
    change_direction: Tensor
    decisions: Tensor
    lane_changes: Tensor
    ego_soft_crash: Tensor
    ego_soft_crash_behind: Tensor
    started_change: Tensor
    step: Tensor
    goal: Tensor
    hard_crash: Tensor
    out_of_road: Tensor
    timeout: Tensor
    soft_crash: Tensor
    soft_crash_behind: Tensor
    done: Tensor
    terminated: Tensor
    truncated: Tensor

    @classmethod
    def empty(cls, rows: int, vehicles: int, make: Callable[..., Tensor] = torch.empty) -> Outcome:
        """Room for the outcome of ``rows`` environments; ``make=torch.zeros``: filled with zeros."""
        shapes = {"vehicle": (rows, vehicles), "row": (rows,), "column": (rows, 1)}
        return cls(*(make(shapes[shape], dtype=dtype) for shape, dtype in OUTCOME.values()))

    def moved(self, before: Vehicles) -> Vehicles:
        """The vehicles after the decision; what does not change within one is that of ``before``."""
        changed = ("x", "y", "heading", "speed", "acceleration", "target_lane")
        return before.with_(**{name: getattr(self, name) for name in changed})


_FLOAT, _INTEGER, _FLAG = torch.float32, torch.int64, torch.bool
#: Shape and dtype of every field of :class:`Outcome`.
OUTCOME: dict[str, tuple[str, torch.dtype]] = {
    **dict.fromkeys(("x", "y", "heading", "speed", "acceleration"), ("vehicle", _FLOAT)),
    "target_lane": ("vehicle", _INTEGER),
    "steering": ("vehicle", _FLOAT),
    **dict.fromkeys(("ego_steering", "mean_acceleration", "change_progress", "distance"), ("row", _FLOAT)),
    **dict.fromkeys(("change_direction", "decisions", "lane_changes"), ("row", _INTEGER)),
    **dict.fromkeys(("ego_soft_crash", "ego_soft_crash_behind", "started_change"), ("row", _FLAG)),
    "step": ("row", _INTEGER),
    **dict.fromkeys(("goal", "hard_crash", "out_of_road", "timeout"), ("column", _FLAG)),
    **dict.fromkeys(("soft_crash", "soft_crash_behind"), ("column", _INTEGER)),
    **dict.fromkeys(("done", "terminated", "truncated"), ("column", _FLAG)),
}
assert tuple(OUTCOME) == Outcome._fields
_EGO = (_FLOAT, *(_INTEGER,) * 3, *(_FLAG,) * 2)
#: Dtypes of what goes in: action, the vehicles' fields, steering, the ego, step, recycles.
INPUTS = (_INTEGER, *(_FLOAT,) * 8, *(_INTEGER,) * 2, _FLAG, _FLOAT, *_EGO, _INTEGER, _FLAG)


class Kernel:
    """Rule-driven traffic and its ego, a whole decision at a time, on a CPU in float32.

    Args:
        road: one for all rows, and straight.
        vehicles: M, the ego included.
        episode: decision period, goal and time-out.
        ego: lane changes and soft crashes.
        idm, steering: of everybody, the ego included.
        mobil: of the others; None: they keep their lanes.
        variant: one of :data:`ganlane.native.library.VARIANTS`; None: the best for this processor.

    Raises:
        UserError: the road is a ring or differs from row to row, or the kernel cannot be built.
    """

    def __init__(
        self,
        road: Road,
        vehicles: int,
        episode: EpisodeParameters | None = None,
        ego: EgoParameters | None = None,
        idm: IdmParameters | None = None,
        steering: SteeringParameters = STEERING,
        mobil: MobilParameters | None = None,
        variant: str | None = None,
    ) -> None:
        self.vehicles, self.variant = vehicles, variant
        self._decide = load(variant).ganlane_decide
        if road.ring_m is not None or isinstance(road.lanes, Tensor) or isinstance(road.lane_width_m, Tensor):
            raise UserError(
                "env.kernel=native: the road must be straight and the same in all rows; set env.kernel=torch."
            )
        self._settings = settings_of(road.lanes, road.lane_width_m, vehicles, episode, ego, idm, steering, mobil)

    def __getstate__(self) -> dict[str, Any]:
        """Without the library, which another process loads for itself."""
        return {name: value for name, value in self.__dict__.items() if name != "_decide"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._decide = load(self.variant).ganlane_decide

    def decide(
        self,
        action: Tensor,
        vehicles: Vehicles,
        steering: Tensor,
        ego: EgoState,
        step: Tensor,
        recycles: Tensor | None = None,
        out: Outcome | None = None,
    ) -> Outcome:
        """One decision of every row.

        Args:
            action: 0 keep, 1 left, 2 right, [N] int64.
            vehicles: fields [N, M], the ego first.
            steering: of the vehicles, rad, [N, M]; the ego's is ``ego.steering``.
            ego: what is remembered of it.
            step: physics steps since the start of the episode, [N] int64.
            recycles: rows that put vehicles left behind ahead of the ego again, [N] bool; None: no row does.
            out: written to; None: new tensors. It must not share memory with what goes in.

        Raises:
            ValueError: an action is not 0, 1 or 2.
        """
        rows = action.shape[0]
        out = Outcome.empty(rows, self.vehicles) if out is None else out
        given = [action, *vehicles, steering, *ego, step, *([] if recycles is None else [recycles])]
        for number, wanted in zip(given, INPUTS):
            if number.dtype is not wanted or number.shape[0] != rows:
                raise TypeError(f"the kernel takes {rows} rows of {wanted} here, not {number.dtype} {number.shape}")
        given = [each.contiguous() for each in given]  # referred to until the call is over
        settings, inputs, outputs = (
            ctypes.byref(self._settings),
            addresses(given, len(INPUTS)),
            addresses(out, len(out)),
        )
        in_threads(rows, lambda first, last: self._decide(settings, inputs, outputs, first, last))
        return out
