"""The kernel on tensors, on a CPU in float32.

A decision, first scenes, the lane view and the mask ``safe``.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import torch
from torch import Tensor

from ganlane.errors import UserError
from ganlane.native import settings
from ganlane.native.library import addresses, in_threads, load
from ganlane.settings.driving import (
    EgoParameters,
    IdmParameters,
    MobilParameters,
    SteeringParameters,
)
from ganlane.settings.episode import EpisodeParameters
from ganlane.settings.observation import ObservationScale
from ganlane.sim.dynamics import STEERING
from ganlane.sim.spawn import RandomScenes
from ganlane.sim.state import Road, Vehicles

#: What a decision led to, by the names of :data:`~ganlane.native.settings.OUTPUTS`: the vehicles'
#: fields and the traffic's ``steering`` [N, M], ``step`` and the ego's memory [N], events and done
#: flags [N, 1].
Outcome: TypeAlias = dict[str, Tensor]
#: What of the ego is remembered from one decision to the next (:mod:`ganlane.env.state`), in the
#: kernel's order.
EGO_MEMORY = (
    "steering",
    "change_direction",
    "decisions",
    "lane_changes",
    "soft_crash",
    "soft_crash_behind",
)
_TABLES = {
    "vehicle": settings.VEHICLE_ARRAYS,
    "row": settings.ROW_ARRAYS,
    "event": settings.EVENT_ARRAYS,
}
#: Form and dtype of the kernel's arrays.
_ARRAYS = {
    name: (form, getattr(torch, dtype))
    for form, table in _TABLES.items()
    for name, dtype in table.items()
}
_INPUT_DTYPES = tuple(_ARRAYS[name][1] for name in settings.INPUTS)


def empty_outcome(rows: int, vehicles: int, make: Callable[..., Tensor] = torch.empty) -> Outcome:
    """Room for the outcome of ``rows`` environments; ``make=torch.zeros``: filled with zeros."""
    shapes, arrays = {"vehicle": (rows, vehicles), "row": (rows,), "event": (rows, 1)}, _ARRAYS
    return {name: make(shapes[arrays[name][0]], dtype=arrays[name][1]) for name in settings.OUTPUTS}


def moved(before: Vehicles, out: Outcome) -> Vehicles:
    """The vehicles after a decision; what does not change within one is that of ``before``."""
    changed = ("x", "y", "heading", "speed", "acceleration", "target_lane")
    return before.with_(**{name: out[name] for name in changed})


def _shape(road: Road, vehicles: int) -> tuple[int, float, int]:
    """Lanes, their width in m, and M."""
    if (
        road.ring_m is not None
        or isinstance(road.lanes, Tensor)
        or isinstance(road.lane_width_m, Tensor)
    ):
        raise UserError(
            "env.kernel=native: the road must be straight and the same in all rows; set env.kernel=torch."
        )
    return road.lanes, road.lane_width_m, vehicles


class _Function:
    """A function of the kernel with its settings.

    ``variant`` is one of :data:`ganlane.native.library.VARIANTS`; None: the best for this
    processor.

    Raises:
        UserError: the road is a ring or differs from row to row, or the kernel cannot be built.
    """

    def __init__(self, name: str, numbers: ctypes.Structure, variant: str | None = None) -> None:
        self._name, self._numbers, self._variant = name, numbers, variant
        self._call = getattr(load(variant), name)

    def __getstate__(self) -> dict[str, Any]:
        """Without the library, which another process loads for itself."""
        return {name: value for name, value in self.__dict__.items() if name != "_call"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._call = getattr(load(self._variant), self._name)

    def _run(self, rows: int, inputs: Sequence[Tensor | None], outputs: Sequence[Tensor]) -> None:
        # Referred to until the call is over.
        inputs = [each if each is None else each.contiguous() for each in inputs]
        call, numbers, given, made = (
            self._call,
            ctypes.byref(self._numbers),
            addresses(inputs),
            addresses(outputs),
        )
        in_threads(rows, lambda first, last: call(numbers, given, made, first, last))


class Kernel(_Function):
    """Rule-driven traffic and its ego, a whole decision at a time.

    Args:
        road: one for all rows, and straight.
        vehicles: M, the ego included.
        episode: decision period, goal and time-out.
        ego: lane changes and soft crashes.
        idm, steering: of everybody, the ego included.
        mobil: of the others; None: they keep their lanes.
        variant: see the base class.
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
        self.vehicles = vehicles
        numbers = settings.settings_of(*_shape(road, vehicles), episode, ego, idm, steering, mobil)
        super().__init__("ganlane_decide", numbers, variant)

    def decide(
        self,
        action: Tensor,
        vehicles: Vehicles,
        steering: Tensor,
        ego: Mapping[str, Tensor],
        step: Tensor,
        recycles: Tensor | None = None,
        out: Outcome | None = None,
    ) -> Outcome:
        """One decision of every row.

        Args:
            action: 0 keep, 1 left, 2 right, [N] int64.
            vehicles: fields [N, M], the ego first.
            steering: of the vehicles, rad, [N, M]; the ego's is its own memory's.
            ego: :data:`EGO_MEMORY` by name, each [N].
            step: physics steps since the start of the episode, [N] int64.
            recycles: rows that put vehicles left behind ahead of the ego again, [N] bool; None: no
                row does.
            out: written to; None: new tensors. It must not share memory with what goes in.

        Raises:
            ValueError: an action is not 0, 1 or 2.
        """
        rows = action.shape[0]
        out = empty_outcome(rows, self.vehicles) if out is None else out
        given = [action, *vehicles, steering, *(ego[name] for name in EGO_MEMORY), step, recycles]
        for number, wanted in zip(given, _INPUT_DTYPES):
            if number is not None and (number.dtype is not wanted or number.shape[0] != rows):
                raise TypeError(
                    f"the kernel takes {rows} rows of {wanted} here, not {number.dtype} {number.shape}"
                )
        self._run(rows, given, tuple(out.values()))
        return out


class NativeScenes(_Function):
    """What :class:`~ganlane.sim.spawn.RandomScenes` draws, bit for bit.

    Drawn by tensor code, the rows that ended took 3 of the 10 ms of a step of 4096 environments
    through TorchRL.

    Args:
        scenes: with a straight road, the same in all rows.
        stream: family of episodes.
    """

    def __init__(self, scenes: RandomScenes, stream: int) -> None:
        self.vehicles, seen = scenes.vehicles, (scenes.ego_visibility, scenes.others_visibility)
        shape = _shape(scenes.road, scenes.vehicles)
        numbers = settings.spawn_of(*shape, scenes.parameters, stream, *seen, recycle_share=None)
        super().__init__("ganlane_spawn", numbers)

    def start(
        self, seed: Tensor, episode: Tensor, rows: Tensor | None = None
    ) -> tuple[Outcome, Vehicles]:
        """The first states of the episodes (``seed``, ``episode``) [N] int64.

        ``rows`` [N] bool are those to be drawn; None: all. The others are zeros, without a vehicle.
        """
        count = seed.shape[0]
        rows = torch.ones(count, dtype=torch.bool) if rows is None else rows
        out = empty_outcome(count, self.vehicles, torch.zeros)
        length, width, desired_speed = (torch.zeros_like(out["x"]) for _ in range(3))
        visibility, valid = (
            torch.zeros_like(out["target_lane"]),
            torch.zeros_like(out["x"], dtype=torch.bool),
        )
        recycles = torch.zeros(count, dtype=torch.bool)
        scene = [seed, episode, rows, length, width, desired_speed, visibility, valid, recycles]
        self._run(count, scene, tuple(out.values()))
        moving = (out["x"], out["y"], out["heading"], out["speed"], out["acceleration"])
        return out, Vehicles(
            *moving, length, width, desired_speed, out["target_lane"], visibility, valid
        )


class LaneView(_Function):
    """Observations of own state, lane view and own lane change
    (:func:`ganlane.transforms.observation.lane_view`).

    Args:
        road: straight, the same in all rows.
        vehicles: M, the ego included.
        scale: range of sight and of relative speeds.
        form: one of :data:`ganlane.native.settings.NATIVE_FORMS`.
    """

    def __init__(self, road: Road, vehicles: int, scale: ObservationScale, form: str) -> None:
        view = settings.view_of(*_shape(road, vehicles), scale, form)
        self.size = view.numbers()
        super().__init__("ganlane_lane_view", view)

    def observe(
        self, vehicles: Vehicles, progress: Tensor, direction: Tensor, seen: Vehicles
    ) -> Tensor:
        """The observation [N, size].

        Arguments as :meth:`ganlane.transforms.ObservationTransform.observe`.
        """
        v = vehicles
        given = [
            v.speed,
            v.desired_speed,
            v.length,
            v.y,
            seen.x,
            seen.y,
            seen.speed,
            seen.valid,
            progress,
            direction,
        ]
        out = torch.empty((v.x.shape[0], self.size), dtype=torch.float32)
        self._run(len(out), given, [out])
        return out


class SafeActions(_Function):
    """The mask ``safe`` (:class:`ganlane.transforms.ActionMaskTransform`).

    It allows lane changes that have an effect and make no vehicle brake harder than is safe.

    Args:
        road: straight, the same in all rows.
        vehicles: M, the ego included.
        idm: by which braking is judged.
        safe_deceleration: m/s2.
        abort: whether the ego may turn back during a lane change.
    """

    def __init__(
        self, road: Road, vehicles: int, idm: IdmParameters, safe_deceleration: float, abort: bool
    ) -> None:
        numbers = settings.safe_settings(*_shape(road, vehicles), idm, safe_deceleration, abort)
        super().__init__("ganlane_mask", numbers)

    def allowed(self, seen: Vehicles, direction: Tensor) -> tuple[Tensor, Tensor]:
        """The mask [N, 3], and whether no action is safe [N], of vehicles as the ego perceives
        them.
        """
        v, rows = seen, seen.x.shape[0]
        given = [v.x, v.y, v.heading, v.speed, v.length, v.width, v.desired_speed]
        given += [v.target_lane, v.visibility, v.valid, direction]
        mask, none = (
            torch.empty((rows, 3), dtype=torch.bool),
            torch.empty((rows,), dtype=torch.bool),
        )
        self._run(rows, given, [mask, none])
        return mask, none
