"""The kernel on tensors, on a CPU in float32.

What the TorchRL environment calls, each the fast twin of tensor code: a decision (:class:`Kernel`),
first scenes (:class:`NativeScenes`), the observation (:class:`LaneView`) and the mask ``safe``
(:class:`SafeActions`).
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.errors import UserError
from ganlane.native import settings
from ganlane.native.drivers import (
    Drivers,
    decision_settings,
    mask_settings,
    parts_of,
    rows_per_thread,
    turns_of,
)
from ganlane.native.library import ROWS_PER_THREAD, addresses, in_threads, load
from ganlane.native.settings import Highway, Key, Layout
from ganlane.settings.actions import ActionParameters
from ganlane.settings.driving import EgoParameters, IdmParameters, MobilParameters
from ganlane.settings.episode import EpisodeParameters
from ganlane.settings.observation import MaskParameters, ObservationScale
from ganlane.sim.spawn import RandomScenes
from ganlane.sim.state import VISIBILITY_OF_EPISODE, Road, Vehicles


def wants_gradient(tensors: Iterable[Tensor]) -> bool:
    """Whether autograd would record a function of ``tensors``; the kernel has no gradients."""
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)


def _room(
    layout: Layout, names: Iterable[Key], rows: int, vehicles: int, make: Callable[..., Tensor]
) -> dict[Key, Tensor]:
    """Tensors for the kernel to write to, by ``torch.empty`` or ``torch.zeros``."""
    room = {}
    for name in names:
        shape = layout.shape(name, rows, vehicles)
        # The environment has its events and flags as [N, 1].
        if name in settings.EVENT_ARRAYS:
            shape += (1,)
        dtype = getattr(torch, layout.kinds[name])
        room[name] = make(shape, dtype=dtype)
    return room


def _state(tensors: Mapping[Key, Tensor]) -> TensorDict:
    """The environment's state [N], without a reward; the kernel drives no scene to its end."""
    groups: dict[str, Any] = {}
    for key, tensor in tensors.items():
        # Into the mapping of its group, ("vehicles", "x") into groups["vehicles"].
        *path, name = (key,) if isinstance(key, str) else key
        group = groups
        for part in path:
            group = group.setdefault(part, {})
        group[name] = tensor

    # Only recorded scenes end by themselves; the flag is there so that all states have the same
    # keys.
    events = groups[keys.EVENTS]
    events["scene_end"] = torch.zeros_like(events["timeout"])

    size = tensors[keys.STEP].shape
    return _tensordict(groups, size)


def _tensordict(groups: Mapping[str, Any], size: torch.Size) -> TensorDict:
    """Nested mappings as a TensorDict [N] on the CPU."""
    fields = {}
    for name, value in groups.items():
        fields[name] = _tensordict(value, size) if isinstance(value, dict) else value

    # Made without TensorDict's checks, since every shape is known.
    return TensorDict._new_unsafe(fields, batch_size=size, device=torch.device("cpu"))


def _highway(road: Road, vehicles: int, actions: ActionParameters | None = None) -> Highway:
    """What the kernel is told of the road, M and the actions (None: lanes).

    Raises:
        UserError: the road is a ring or differs from row to row.
    """
    lanes = road.lanes
    width_m = road.lane_width_m

    # The kernel has one number of lanes and one width for all rows.
    if isinstance(lanes, Tensor) or isinstance(width_m, Tensor) or road.ring_m is not None:
        raise UserError(
            "env.kernel=native: the road must be straight and the same in all rows; "
            "set env.kernel=torch."
        )

    return Highway(
        lanes=lanes,
        lane_width_m=width_m,
        vehicles=vehicles,
        stretches=road.stretches,
        flow=road.flow,
        actions=actions or ActionParameters(),
    )


class _Remade:
    """Made anew from its arguments for copies and other processes: addresses hold in this process
    alone.
    """

    _arguments: partial[_Remade]

    def __new__(cls, *arguments: Any, **named: Any) -> Any:
        instance = super().__new__(cls)
        instance._arguments = partial(cls, *arguments, **named)
        return instance

    def __reduce__(self) -> tuple[partial[_Remade], tuple[()]]:
        return self._arguments, ()


class _Function(_Remade):
    """A function of the kernel with its settings.

    ``variant`` is one of :data:`ganlane.native.library.VARIANTS`; None: the best for this
    processor. ``rows_per_thread``: rows from which on a further thread pays.

    Raises:
        UserError: the road is a ring or differs from row to row, or the kernel cannot be built.
    """

    def __init__(
        self,
        name: str,
        numbers: ctypes.Structure,
        variant: str | None = None,
        rows_per_thread: int = ROWS_PER_THREAD,
    ) -> None:
        self._numbers = numbers
        self._rows_per_thread = rows_per_thread
        self._call = getattr(load(variant), name)

    def run(
        self, rows: int, inputs: Iterable[Tensor | None], outputs: Sequence[Tensor | None]
    ) -> None:
        """Call it on ``rows`` rows, with its arrays in the kernel's order.

        ``outputs`` are contiguous, and written to; None: an array that the highway lacks.
        """
        # The contiguous copies have to live until the call is over.
        read = [tensor if tensor is None else tensor.contiguous() for tensor in inputs]
        pointers = (ctypes.byref(self._numbers), addresses(read), addresses(outputs))
        in_threads(rows, self._call, pointers, self._rows_per_thread)


class _Parts(_Remade):
    """What drives the rows of each part of the drivers.

    ``layouts`` are those of the parts, ``layout`` is that of the whole state.
    """

    def __init__(self, drivers: Drivers, highway: Highway) -> None:
        self.vehicles = highway.vehicles
        self.layout = Layout(drivers.memory(), highway)
        self.parts = parts_of(drivers)
        self.layouts = [Layout(part.memory, highway) for part in self.parts]
        self._turns = torch.tensor(turns_of(drivers))

    def of_part(self, number: int, episode: Tensor) -> Tensor:
        """Whether each episode [N] belongs to the part."""
        return self._turns[episode % len(self._turns)] == number


class Kernel(_Parts):
    """Traffic and its ego, a whole decision at a time.

    Args:
        road: one for all rows, and straight.
        vehicles: M, the ego included.
        episode: decision period, goal and time-out.
        ego: lane changes and soft crashes.
        drivers: the others, and how the ego follows and steers.
        variant: see :class:`_Function`.
        actions: what the ego is commanded; None: lanes.
        mobil: how the ego falls behind before a lane change that it has to make; None: as others.
    """

    def __init__(
        self,
        road: Road,
        vehicles: int,
        episode: EpisodeParameters,
        ego: EgoParameters,
        drivers: Drivers,
        variant: str | None = None,
        actions: ActionParameters | None = None,
        mobil: MobilParameters | None = None,
    ) -> None:
        highway = _highway(road, vehicles, actions)
        super().__init__(drivers, highway)
        self._controls = not highway.actions.names
        self._functions = []
        for part in self.parts:
            numbers = decision_settings(highway, part.drivers, episode, ego, mobil)
            function = _Function(
                "ganlane_decide",
                numbers,
                variant,
                rows_per_thread(part.drivers),
            )
            self._functions.append(function)

    def decide(
        self, action: Tensor, state: TensorDictBase, recycles: Tensor | None = None
    ) -> TensorDict:
        """The state after one decision of every row, without a reward.

        Args:
            action: numbered, [N] int64, or controls [N, 2].
            state: of the environment (:mod:`ganlane.keys`); it stays as it is.
            recycles: rows that put vehicles left behind ahead of the ego again, or on a road with a
                flow those in which vehicles enter and leave, [N] bool; None: no row does.

        Raises:
            ValueError: an action is none that there is.
            TypeError: a part of the state is not as the kernel reads it.
        """
        rows = action.shape[0]
        layout = self.layout

        # What the kernel reads, by key; for what is missing it gets null pointers.
        before: dict[Key, Tensor | None] = {"recycles": recycles}
        if self._controls:
            before[keys.ACTION] = None
            before["controls"] = action.float()
        else:
            before[keys.ACTION] = action

        for name in layout.inputs:
            if name in before or name not in layout.kinds:
                continue
            # Group by group: to look up a nested key takes three times as long.
            tensor: Any = state
            for part in (name,) if isinstance(name, str) else name:
                tensor = tensor.get(part)
            # A wrong type would be read as other numbers, without an error.
            dtype = getattr(torch, layout.kinds[name])
            if tensor.dtype is not dtype or tensor.shape[0] != rows:
                raise TypeError(
                    f"the kernel takes {rows} rows of {dtype} as {name}, "
                    f"not {tensor.dtype} {tensor.shape}"
                )
            before[name] = tensor

        # New tensors: the state before the decision belongs to the caller.
        after = _room(layout, layout.written, rows, self.vehicles, torch.empty)

        several = len(self.parts) > 1
        if several:
            # A part writes the memory of its own rows alone; in the others it is as it was.
            for name in layout.written:
                if name[0] == keys.TRAFFIC:
                    after[name] = before[name].clone()  # type: ignore[union-attr]

        for number, function in enumerate(self._functions):
            if several:
                # The kernel drives the rows in this list.
                belongs = self.of_part(number, state.get(keys.EPISODE))
                chosen = belongs.nonzero()[:, 0]
                before["rows"] = chosen
                rows = len(chosen)
            part_layout = self.layouts[number]
            inputs = [before.get(name) for name in part_layout.inputs]
            outputs = [after.get(name) for name in part_layout.outputs]
            function.run(rows, inputs, outputs)

        # What no decision changes is shared with the state before, not copied.
        lasting = {name: before[name] for name in (*settings.SCENE, keys.SEED, keys.EPISODE)}
        return _state(lasting | after)  # type: ignore[arg-type]


class NativeScenes(_Parts):
    """What :class:`~ganlane.sim.spawn.RandomScenes` draws, bit for bit, and the drivers' memory.

    Drawn by tensor code, the rows that ended took 3 of the 10 ms of a step of 4096 environments
    through TorchRL.

    Args:
        scenes: with a straight road, the same in all rows.
        stream: family of episodes.
        drivers: of the others.
        actions: what the ego is commanded; None: lanes.
    """

    def __init__(
        self,
        scenes: RandomScenes,
        stream: int,
        drivers: Drivers,
        actions: ActionParameters | None = None,
    ) -> None:
        highway = _highway(scenes.road, scenes.vehicles, actions)
        super().__init__(drivers, highway)
        self._functions = []
        for part in self.parts:
            others_visibility = scenes.others_visibility
            if others_visibility == VISIBILITY_OF_EPISODE:
                others_visibility = part.drivers.visibility
            spawn = settings.spawn_of(
                highway,
                scenes.parameters,
                stream,
                scenes.ego_visibility,
                others_visibility,
                recycle_share=None,
            )
            enter = decision_settings(highway, part.drivers)

            # The scene first, then the drivers' memory of it.
            functions = (
                _Function("ganlane_spawn", spawn),
                _Function("ganlane_enter", enter),
            )
            self._functions.append(functions)

    def start(self, seed: Tensor, episode: Tensor, rows: Tensor | None = None) -> TensorDict:
        """The first states of the episodes (``seed``, ``episode``) [N] int64.

        ``rows`` [N] bool are those to be drawn; None: all. The others are zeros, without a vehicle.
        """
        if rows is None:
            rows = torch.ones_like(seed, dtype=torch.bool)

        # Zeros, since rows that are not drawn are not written.
        layout = self.layout
        names = (*layout.written, *settings.SCENE)
        state = _room(layout, names, len(seed), self.vehicles, torch.zeros)
        state[keys.SEED] = seed
        state[keys.EPISODE] = episode

        for number, functions in enumerate(self._functions):
            arrays = state | {
                "fresh": rows & self.of_part(number, episode),
                # Whether it recycles is drawn with the scene, but the environment draws it, too.
                "recycles": torch.zeros_like(rows),
            }
            inputs = [arrays[name] for name in settings.STARTS]
            outputs = [state.get(name) for name in self.layouts[number].outputs]
            for function in functions:
                function.run(len(seed), inputs, outputs)
        return _state(state)


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
        highway = _highway(road, vehicles)
        view = settings.view_of(highway, scale, form)
        self.size = view.numbers()
        super().__init__("ganlane_lane_view", view)

    def observe(
        self, vehicles: Vehicles, progress: Tensor, direction: Tensor, seen: Vehicles
    ) -> Tensor:
        """The observation [N, size].

        Arguments as :meth:`ganlane.transforms.ObservationTransform.observe`.
        """
        # In the order of observation.cpp: the ego as it is, the others as they are seen. In the
        # place of the set speed there is none: the transform adds what a driver needs for more
        # than lanes.
        inputs = [
            *(getattr(vehicles, name) for name in settings.VIEWED_EGO.split()),
            *(getattr(seen, name) for name in settings.VIEWED.split()),
            progress,
            direction,
            vehicles.x,
            vehicles.heading,
            None,
        ]

        rows = len(vehicles.x)
        observation = torch.empty((rows, self.size), dtype=torch.float32)
        self.run(rows, inputs, [observation])
        return observation


class SafeActions(_Function):
    """The masks ``safe`` and ``foresight`` (:class:`ganlane.transforms.ActionMaskTransform`).

    They allow lane changes that have an effect and make no vehicle brake harder than is safe.

    Args:
        road: straight, the same in all rows.
        vehicles: M, the ego included.
        idm: by which braking is judged.
        mask: which of the two, and its deceleration.
        abort: whether the ego may turn back during a lane change.
    """

    def __init__(
        self, road: Road, vehicles: int, idm: IdmParameters, mask: MaskParameters, abort: bool
    ) -> None:
        highway = _highway(road, vehicles)
        numbers = mask_settings(highway, idm, mask, abort)
        super().__init__("ganlane_mask", numbers)

    def allowed(self, seen: Vehicles, direction: Tensor) -> tuple[Tensor, Tensor]:
        """The mask [N, 3], and whether no action is safe [N].

        ``seen`` are the vehicles as the ego perceives them, ``direction`` [N] that of its current
        lane change.
        """
        # In the order of mask.cpp.
        inputs = [
            *(getattr(seen, name) for name in settings.MASKED.split()),
            direction,
        ]

        rows = len(seen.x)
        mask = torch.empty(rows, keys.ACTIONS, dtype=torch.bool)
        no_safe_action = torch.empty(rows, dtype=torch.bool)
        self.run(rows, inputs, [mask, no_safe_action])
        return mask, no_safe_action
