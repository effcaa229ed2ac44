"""The kernel on tensors, on a CPU in float32.

A decision, first scenes, the lane view and the mask ``safe``.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.errors import UserError
from ganlane.native import settings
from ganlane.native.library import addresses, in_threads, load
from ganlane.native.settings import Key
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

# The kernel reads memory as it lies, so types have to match exactly.
_TYPES = settings.VEHICLE_ARRAYS | settings.EGO_ARRAYS | settings.EVENT_ARRAYS
_DTYPES = {key: getattr(torch, name) for key, name in _TYPES.items()}
_DTYPES[keys.STEP] = torch.int64
#: Fields of ``vehicles`` that no decision changes.
_LASTING = [
    key for key in settings.INPUTS if key[0] == keys.VEHICLES and key not in settings.OUTPUTS
]


def wants_gradient(tensors: Iterable[Tensor]) -> bool:
    """Whether autograd would record a function of ``tensors``; the kernel has no gradients."""
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)


def _room(
    names: Iterable[Key], rows: int, vehicles: int, make: Callable[..., Tensor]
) -> dict[Key, Tensor]:
    """Tensors for the kernel to write to, by ``torch.empty`` or ``torch.zeros``."""
    room = {}
    for name in names:
        shape: tuple[int, ...] = (rows,)
        if name in settings.VEHICLE_ARRAYS:
            shape = (rows, vehicles)
        elif name in settings.EVENT_ARRAYS:
            # As the environment has its events and flags.
            shape = (rows, 1)
        room[name] = make(shape, dtype=_DTYPES[name])
    return room


def _state(tensors: Mapping[Key, Tensor]) -> TensorDict:
    """The environment's state [N], without a reward; the kernel drives no scene to its end."""
    # Made without TensorDict's checks, since every shape is known.
    size = tensors[keys.STEP].shape
    device = torch.device("cpu")
    groups: dict[str, dict[str, Tensor]] = {}
    fields: dict[str, Any] = {}
    for key, value in tensors.items():
        if isinstance(key, str):
            fields[key] = value
        else:
            groups.setdefault(key[0], {})[key[1]] = value
    # Only recorded scenes end by themselves; the flag is there so that all states have the same
    # keys.
    groups[keys.EVENTS]["scene_end"] = torch.zeros_like(groups[keys.EVENTS]["timeout"])
    for name, group in groups.items():
        fields[name] = TensorDict._new_unsafe(group, batch_size=size, device=device)
    return TensorDict._new_unsafe(fields, batch_size=size, device=device)


def _shape(road: Road, vehicles: int) -> tuple[int, float, int]:
    """Lanes, their width in m, and M."""
    # The settings have one number of lanes and one width for all rows.
    of_rows = isinstance(road.lanes, Tensor) or isinstance(road.lane_width_m, Tensor)
    if of_rows or road.ring_m is not None:
        raise UserError(
            "env.kernel=native: the road must be straight and the same in all rows; "
            "set env.kernel=torch."
        )
    return road.lanes, road.lane_width_m, vehicles  # type: ignore[return-value]


class _Function:
    """A function of the kernel with its settings.

    ``variant`` is one of :data:`ganlane.native.library.VARIANTS`; None: the best for this
    processor.

    Raises:
        UserError: the road is a ring or differs from row to row, or the kernel cannot be built.
    """

    def __init__(
        self,
        name: str,
        numbers: ctypes.Structure,
        variant: str | None = None,
    ) -> None:
        self._name = name
        self._numbers = numbers
        self._variant = variant
        # A function of ctypes cannot be pickled; __getstate__ leaves it out.
        self._call = getattr(load(variant), name)

    def __getstate__(self) -> dict[str, Any]:
        """Without the library, which another process loads for itself."""
        return {name: value for name, value in self.__dict__.items() if name != "_call"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._call = getattr(load(self._variant), self._name)

    def _run(
        self,
        rows: int,
        inputs: Iterable[Tensor | None],
        outputs: Sequence[Tensor],
    ) -> None:
        # The contiguous copies have to live until the call is over.
        read = [tensor if tensor is None else tensor.contiguous() for tensor in inputs]
        pointers = (ctypes.byref(self._numbers), addresses(read), addresses(outputs))
        # ctypes releases Python's lock during a call, so threads run side by side.
        in_threads(rows, lambda first, last: self._call(*pointers, first, last))


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
        numbers = settings.settings_of(
            *_shape(road, vehicles),
            episode,
            ego,
            idm,
            steering,
            mobil,
        )
        super().__init__("ganlane_decide", numbers, variant)

    def decide(
        self, action: Tensor, state: TensorDictBase, recycles: Tensor | None = None
    ) -> TensorDict:
        """The state after one decision of every row, without a reward.

        Args:
            action: 0 keep, 1 left, 2 right, [N] int64.
            state: of the environment (:mod:`ganlane.keys`); it stays as it is.
            recycles: rows that put vehicles left behind ahead of the ego again, [N] bool; None: no
                row does.

        Raises:
            ValueError: an action is not 0, 1 or 2.
            TypeError: a part of the state is not as the kernel reads it.
        """
        rows = action.shape[0]
        before: dict[Key, Tensor] = {}
        for name in settings.INPUTS:
            # Group by group: to look up a nested key takes three times as long.
            number = state
            for part in (name,) if isinstance(name, str) else name:
                number = number.get(part)
            # A wrong type would be read as other numbers, without an error.
            if number.dtype is not _DTYPES[name] or number.shape[0] != rows:
                raise TypeError(
                    f"the kernel takes {rows} rows of {_DTYPES[name]} as {name}, "
                    f"not {number.dtype} {number.shape}"
                )
            before[name] = number
        # New tensors: the state before the decision belongs to the caller.
        after = _room(
            settings.OUTPUTS,
            rows,
            self.vehicles,
            torch.empty,
        )
        self._run(rows, [action, *before.values(), recycles], list(after.values()))
        # What no decision changes is shared with the state before, not copied.
        after |= {name: before[name] for name in _LASTING}
        after |= {name: state.get(name) for name in (keys.SEED, keys.EPISODE)}
        return _state(after)


class NativeScenes(_Function):
    """What :class:`~ganlane.sim.spawn.RandomScenes` draws, bit for bit.

    Drawn by tensor code, the rows that ended took 3 of the 10 ms of a step of 4096 environments
    through TorchRL.

    Args:
        scenes: with a straight road, the same in all rows.
        stream: family of episodes.
    """

    def __init__(self, scenes: RandomScenes, stream: int) -> None:
        self.vehicles = scenes.vehicles
        seen = (scenes.ego_visibility, scenes.others_visibility)
        shape = _shape(scenes.road, scenes.vehicles)
        numbers = settings.spawn_of(
            *shape,
            scenes.parameters,
            stream,
            *seen,
            recycle_share=None,
        )
        super().__init__("ganlane_spawn", numbers)

    def start(
        self,
        seed: Tensor,
        episode: Tensor,
        rows: Tensor | None = None,
    ) -> TensorDict:
        """The first states of the episodes (``seed``, ``episode``) [N] int64.

        ``rows`` [N] bool are those to be drawn; None: all. The others are zeros, without a vehicle.
        """
        rows = torch.ones_like(seed, dtype=torch.bool) if rows is None else rows
        # Zeros, since rows that are not drawn are not written.
        names = (*settings.OUTPUTS, *settings.SCENE)
        state = _room(
            names,
            len(seed),
            self.vehicles,
            torch.zeros,
        )
        scene = [state[name] for name in settings.SCENE]
        # Drawn with the scene, but the environment draws it at every decision.
        recycles = torch.zeros_like(rows)
        outputs = [state[name] for name in settings.OUTPUTS]
        self._run(len(seed), [seed, episode, rows, *scene, recycles], outputs)
        return _state(state | {keys.SEED: seed, keys.EPISODE: episode})


class LaneView(_Function):
    """Observations of own state, lane view and own lane change
    (:func:`ganlane.transforms.observation.lane_view`).

    Args:
        road: straight, the same in all rows.
        vehicles: M, the ego included.
        scale: range of sight and of relative speeds.
        form: one of :data:`ganlane.native.settings.NATIVE_FORMS`.
    """

    def __init__(
        self,
        road: Road,
        vehicles: int,
        scale: ObservationScale,
        form: str,
    ) -> None:
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
        inputs = [
            v.speed,
            v.desired_speed,
            v.length,
            v.y,
            seen.x,
            seen.y,
            seen.speed,
            seen.valid,
        ]
        # In the order of observation.cpp: the ego as it is, the others as they are seen.
        out = torch.empty((len(v.x), self.size), dtype=torch.float32)
        self._run(len(out), [*inputs, progress, direction], [out])
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
        numbers = settings.mask_of(
            *_shape(road, vehicles),
            idm,
            safe_deceleration,
            abort,
        )
        super().__init__("ganlane_mask", numbers)

    def allowed(self, seen: Vehicles, direction: Tensor) -> tuple[Tensor, Tensor]:
        """The mask [N, 3], and whether no action is safe [N].

        ``seen`` are the vehicles as the ego perceives them, ``direction`` [N] that of its current
        lane change.
        """
        v = seen
        rows = seen.x.shape[0]
        inputs = [v.x, v.y, v.heading, v.speed, v.length, v.width, v.desired_speed]
        # In the order of the structure in C++.
        inputs += [v.target_lane, v.visibility, v.valid, direction]
        mask = torch.empty(rows, 3, dtype=torch.bool)
        none = torch.empty(rows, dtype=torch.bool)
        self._run(rows, inputs, [mask, none])
        return mask, none
