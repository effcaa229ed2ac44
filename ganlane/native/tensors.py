"""The kernel on tensors, on a CPU in float32.

A decision, first scenes, the lane view and the mask ``safe``.
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
        # As the environment has its events and flags.
        column = (1,) if name in settings.EVENT_ARRAYS else ()
        shape = layout.shape(name, rows, vehicles) + column
        room[name] = make(shape, dtype=getattr(torch, layout.kinds[name]))
    return room


def _state(tensors: Mapping[Key, Tensor]) -> TensorDict:
    """The environment's state [N], without a reward; the kernel drives no scene to its end."""
    size = tensors[keys.STEP].shape
    # Only recorded scenes end by themselves; the flag is there so that all states have the same
    # keys.
    scene_end = torch.zeros_like(tensors[keys.EVENTS, "timeout"])
    groups: dict[str, Any] = {}
    for key, value in [*tensors.items(), ((keys.EVENTS, "scene_end"), scene_end)]:
        *path, name = (key,) if isinstance(key, str) else key
        group = groups
        for part in path:
            group = group.setdefault(part, {})
        group[name] = value
    return _tensordict(groups, size)


def _tensordict(groups: Mapping[str, Any], size: torch.Size) -> TensorDict:
    """Nested mappings as a TensorDict [N] on the CPU."""
    fields = {
        name: _tensordict(value, size) if isinstance(value, dict) else value
        for name, value in groups.items()
    }
    # Made without TensorDict's checks, since every shape is known.
    return TensorDict._new_unsafe(fields, batch_size=size, device=torch.device("cpu"))


def _highway(road: Road, vehicles: int, actions: ActionParameters | None = None) -> Highway:
    """What the kernel is told of the road, M and the actions (None: lanes)."""
    # The settings have one number of lanes and one width for all rows.
    lanes, width_m = road.lanes, road.lane_width_m
    if isinstance(lanes, Tensor) or isinstance(width_m, Tensor) or road.ring_m is not None:
        raise UserError(
            "env.kernel=native: the road must be straight and the same in all rows; "
            "set env.kernel=torch."
        )
    commands = actions or ActionParameters()
    return Highway(lanes, width_m, vehicles, road.stretches, road.flow, commands)


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
        """Call it on ``rows`` rows, with its arrays in the kernel's order."""
        # The contiguous copies have to live until the call is over.
        read = [tensor if tensor is None else tensor.contiguous() for tensor in inputs]
        pointers = (ctypes.byref(self._numbers), addresses(read), addresses(outputs))
        # ctypes releases Python's lock during a call, so threads run side by side.
        in_threads(
            rows, lambda first, last: self._call(*pointers, first, last), self._rows_per_thread
        )


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
            per_thread = rows_per_thread(part.drivers)
            self._functions.append(_Function("ganlane_decide", numbers, variant, per_thread))

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
        arrays: dict[Key, Tensor | None] = {"recycles": recycles, keys.ACTION: action}
        if self._controls:
            arrays |= {keys.ACTION: None, "controls": action.float()}
        for name in layout.inputs:
            if name in arrays or name not in layout.kinds:
                continue
            # Group by group: to look up a nested key takes three times as long.
            number: Any = state
            for part in (name,) if isinstance(name, str) else name:
                number = number.get(part)
            # A wrong type would be read as other numbers, without an error.
            dtype = getattr(torch, layout.kinds[name])
            if number.dtype is not dtype or number.shape[0] != rows:
                raise TypeError(
                    f"the kernel takes {rows} rows of {dtype} as {name}, "
                    f"not {number.dtype} {number.shape}"
                )
            arrays[name] = number
        # New tensors: the state before the decision belongs to the caller.
        after = _room(layout, layout.written, rows, self.vehicles, torch.empty)
        several = len(self.parts) > 1
        if several:
            # What a part does not write is as it was.
            for name in layout.written:
                if name[0] == keys.TRAFFIC:
                    after[name] = arrays[name].clone()  # type: ignore[union-attr]
        for number, (function, of_part) in enumerate(zip(self._functions, self.layouts)):
            if several:
                chosen = self.of_part(number, state.get(keys.EPISODE))
                arrays["rows"] = numbers = chosen.nonzero()[:, 0]
                rows = len(numbers)
            outputs = [after.get(name) for name in of_part.outputs]
            function.run(rows, map(arrays.get, of_part.inputs), outputs)
        # What no decision changes is shared with the state before, not copied.
        lasting = {name: arrays[name] for name in (*settings.SCENE, keys.SEED, keys.EPISODE)}
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
            others = scenes.others_visibility
            others = part.drivers.visibility if others == VISIBILITY_OF_EPISODE else others
            start = (stream, scenes.ego_visibility, others, None)
            spawn = settings.spawn_of(highway, scenes.parameters, *start)
            enter = decision_settings(highway, part.drivers)
            # The scene first, then the drivers' memory of it.
            functions = (_Function("ganlane_spawn", spawn), _Function("ganlane_enter", enter))
            self._functions.append(functions)

    def start(self, seed: Tensor, episode: Tensor, rows: Tensor | None = None) -> TensorDict:
        """The first states of the episodes (``seed``, ``episode``) [N] int64.

        ``rows`` [N] bool are those to be drawn; None: all. The others are zeros, without a vehicle.
        """
        rows = torch.ones_like(seed, dtype=torch.bool) if rows is None else rows
        layout = self.layout
        # Zeros, since rows that are not drawn are not written.
        names = (*layout.written, *settings.SCENE)
        state = _room(layout, names, len(seed), self.vehicles, torch.zeros)
        state |= {keys.SEED: seed, keys.EPISODE: episode}
        for number, functions in enumerate(self._functions):
            # Whether it recycles is drawn with the scene, but the environment draws it, too.
            flags = {"recycles": torch.zeros_like(rows)}
            flags["fresh"] = rows & self.of_part(number, episode)
            inputs = [(state | flags)[name] for name in settings.STARTS]
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
        view = settings.view_of(_highway(road, vehicles), scale, form)
        self.size = view.numbers()
        super().__init__("ganlane_lane_view", view)

    def observe(
        self, vehicles: Vehicles, progress: Tensor, direction: Tensor, seen: Vehicles
    ) -> Tensor:
        """The observation [N, size].

        Arguments as :meth:`ganlane.transforms.ObservationTransform.observe`.
        """
        v = vehicles
        # In the order of observation.cpp: the ego as it is, the others as they are seen.
        inputs = [getattr(v, name) for name in settings.VIEWED_EGO.split()]
        inputs += [getattr(seen, name) for name in settings.VIEWED.split()]
        inputs += [progress, direction, v.x, v.heading, None]
        out = torch.empty((len(v.x), self.size), dtype=torch.float32)
        self.run(len(out), inputs, [out])
        return out


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
        numbers = mask_settings(_highway(road, vehicles), idm, mask, abort)
        super().__init__("ganlane_mask", numbers)

    def allowed(self, seen: Vehicles, direction: Tensor) -> tuple[Tensor, Tensor]:
        """The mask [N, 3], and whether no action is safe [N].

        ``seen`` are the vehicles as the ego perceives them, ``direction`` [N] that of its current
        lane change.
        """
        rows = len(seen.x)
        inputs = [getattr(seen, name) for name in settings.MASKED.split()]
        mask = torch.empty(rows, 3, dtype=torch.bool)
        none = torch.empty(rows, dtype=torch.bool)
        self.run(rows, [*inputs, direction], [mask, none])
        return mask, none
