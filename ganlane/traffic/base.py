"""The contract of traffic models, which move the other vehicles by 0.1 s, and chains of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from ganlane import keys
from ganlane.errors import UserError
from ganlane.keys import PHYSICS_STEP_S
from ganlane.native.drivers import Drivers
from ganlane.settings.driving import Visibility
from ganlane.sim.random import Stream, absorb, episode_key, uniform
from ganlane.sim.scenes import Scenes
from ganlane.sim.state import Road, Vehicles
from ganlane.torch_settings import outside_autocast

#: A module's memory: name to tensor [N, M, ...].
Memory = dict[str, Tensor]
#: The vehicles after a step, and the memory to keep.
Moved = tuple[Vehicles, Memory]
#: The initial scene of episodes, and the memory.
Entered = tuple[Vehicles, TensorDictBase]
#: Name to (trailing shape after [N, M], dtype), the dtype None being the run's float type; of a
#: traffic made of others by their names.
MemoryFields = Mapping[str, Any]
Network = TypeVar("Network", bound=nn.Module)


def new_tensordict(fields: Mapping[str, Any], n: int) -> TensorDict:
    """A TensorDict [N] of tensors and TensorDicts of N = ``n`` rows.

    Without TensorDict's checks, which cost as much as a step of a small batch.
    """
    # TensorDict's private constructor: the shapes are right by construction.
    return TensorDict._new_unsafe(dict(fields), batch_size=torch.Size([n]))


def zero_memory(fields: MemoryFields, x: Tensor) -> dict[str, Any]:
    """Zeros for the ``fields`` of rows of vehicles at ``x`` [N, M]; nested as they are."""
    memory: dict[str, Any] = {}
    for name, field in fields.items():
        if isinstance(field, Mapping):
            memory[name] = new_tensordict(zero_memory(field, x), len(x))
        else:
            shape, dtype = field
            memory[name] = x.new_zeros((*x.shape, *shape), dtype=dtype)
    return memory


def memory_of(tensordict: TensorDictBase, key: str = keys.TRAFFIC) -> TensorDictBase:
    """The memory under ``key``; empty if it is missing, since TorchRL drops empty TensorDicts."""
    memory = tensordict.get(key, None)
    if memory is None:
        return TensorDict({}, batch_size=tensordict.batch_size)
    return memory


def with_rows(whole: TensorDictBase, rows: Tensor, part: Mapping[str, Any]) -> TensorDict:
    """``whole`` [N] with its ``rows`` [R] replaced by those of ``part``, leaf by leaf.

    Nothing is written in place; what ``part`` lacks stays.
    """
    fields = dict(whole.items())
    for name, value in part.items():
        if isinstance(value, Tensor):
            # Not index_copy_, which would write into the caller's tensor.
            fields[name] = fields[name].index_copy(0, rows, value)
        # TorchRL drops empty TensorDicts between decisions.
        elif name in fields:
            fields[name] = with_rows(fields[name], rows, value)
    return new_tensordict(fields, whole.batch_size[0])


def where_rows(rows: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """``new`` where ``rows`` [N] is true, ``old`` elsewhere; both [N, ...]."""
    # [N, 1, ...], with as many dimensions as the tensors.
    ones = [1] * (new.ndim - 1)
    return torch.where(rows.view(-1, *ones), new, old)


def key_of(tensordict: TensorDictBase, stream: int) -> Tensor:
    """The episodes' keys [N]: those that the caller has computed, or from seed and episode."""
    key = tensordict.get(keys.EPISODE_KEY, None)
    if key is None:
        return episode_key(stream, tensordict.get(keys.SEED), tensordict.get(keys.EPISODE))
    return key


def uniforms(
    vehicles: Vehicles, key: Tensor, step: Tensor | int, *purposes: int
) -> tuple[Tensor, ...]:
    """A uniform number in [0, 1) for every vehicle, [N, M], of each of the ``purposes``.

    Args:
        vehicles: whose number M and float type count.
        key: of the episodes, [N].
        step: physics steps since their start, [N]; -1 before the first one.
        purposes: one for each use, so that they are independent of each other.
    """
    # All purposes in one call, which shares the hashing of episode and step.
    x = vehicles.x
    return uniform(key, step, x.shape[1], list(purposes), x.dtype).unbind(-1)


def in_dtype(network: Network, dtype: torch.dtype) -> Network:
    """A fitted ``network`` in the run's float type."""
    # Weights are stored in float32, a run may be in float64; converted once.
    if next(network.parameters()).dtype != dtype:
        network.to(dtype)
    return network


class TrafficModule(TensorDictModuleBase):
    """Base of all traffic models.

    In keys: ``vehicles`` (the state at t, never written), ``traffic`` (the module's memory),
    ``seed``, ``episode``, ``step`` ([N] int64); optional: ``episode_key``. Out keys: ``moved`` (the
    same fields as ``vehicles``, the others at t + 0.1 s) and ``traffic``. Index 0 is the ego: the
    environment overwrites it. Fields of invalid vehicles may be any finite numbers. Random numbers
    come from :mod:`ganlane.sim.random` and the counters only.

    A model of your own needs one method, :meth:`move`; one with a memory also names
    :attr:`memory_fields`, and fills them in :meth:`fresh_memory` unless they begin with zeros::

        class Cruise(TrafficModule):
            def move(self, vehicles, memory, key, step):
                return vehicles.with_(x=vehicles.x + vehicles.speed * self.dt), memory

    Args:
        road: lanes and lane width, fixed for the module's life.
        stream: family of episodes that the random numbers belong to.
    """

    in_keys = [keys.VEHICLES, keys.TRAFFIC, keys.SEED, keys.EPISODE, keys.STEP]  # noqa: RUF012
    out_keys = [keys.MOVED, keys.TRAFFIC]  # noqa: RUF012

    #: When others see the lane changes of this model's vehicles; ``VISIBILITY_OF_EPISODE`` if
    #: :meth:`enter` sets it per episode.
    visibility: int = Visibility.SIGNALLED
    #: Whether lanes and lane width differ between rows (:meth:`road_of`).
    own_roads: bool = False
    #: Whether a running episode has to keep its row of the batch, since the module holds state per
    #: row outside ``traffic`` (a foreign simulator). New episodes are recognised by step 0 of their
    #: (seed, episode).
    rows_must_stay: bool = False
    #: Whether its vehicles stop before the end of a lane and change only between lanes that exist.
    heeds_lane_ends: bool = False
    #: Per-vehicle memory; empty for a model without any.
    memory_fields: MemoryFields = {}  # noqa: RUF012

    def __init__(self, road: Road | None = None, stream: int = Stream.TRAIN) -> None:
        super().__init__()
        self.road = road or Road()
        self.stream = int(stream)
        # Under a short name, for models of your own.
        self.dt = PHYSICS_STEP_S

    def move(self, vehicles: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        """The vehicles at t + 0.1 s, and the memory to keep.

        Args:
            vehicles: at t, fields [N, M].
            memory: name to tensor [N, M, ...].
            key: the episodes' keys [N] int64, for random numbers.
            step: physics steps since the start of the episode, [N] int64.
        """
        raise NotImplementedError

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> Memory:
        """Memory as if every vehicle had just entered, here zeros.

        ``key`` [N] is for random parameters.
        """
        return zero_memory(self.memory_fields, vehicles.x)

    def road_of(self, key: Tensor, dtype: torch.dtype) -> Road:
        """The road of the episodes with ``key`` [N]."""
        return self.road

    def steps_of(self, key: Tensor) -> Tensor | None:
        """Physics steps [N] int64 after which an episode ends (``scene_end``); None: never."""
        return None

    def scenes(
        self, vehicles: int, ego_visibility: int, ego_desired_speed_mps: float
    ) -> Scenes | None:
        """The initial scenes of this traffic; None: those of the environment."""
        return None

    def native_drivers(self) -> Drivers | None:
        """What the native kernel needs to drive as this model does; None: it cannot."""
        return None

    # Below: TensorDicts in and out, so that models can be chained and stored. A model of your own
    # needs nothing of it.

    @outside_autocast
    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """:meth:`forward` in the run's float type.

        Episodes are the same whatever a caller's autocast does.
        """
        return super().__call__(*arguments, **named)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``moved`` and ``traffic``."""
        # Plain fields from here on, so that a model needs to know nothing of TensorDicts.
        memory = dict(memory_of(tensordict).items())
        key = key_of(tensordict, self.stream)
        step = tensordict.get(keys.STEP)
        moved, memory = self._call(tensordict, memory, key, step)

        n = tensordict.batch_size[0]
        tensordict.set(keys.MOVED, new_tensordict(moved.as_dict(), n))
        return tensordict.set(keys.TRAFFIC, new_tensordict(memory, n))

    def _call(self, state: TensorDictBase, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        vehicles = Vehicles.of(state.get(keys.VEHICLES))
        return self.move(vehicles, memory, key, step)

    @outside_autocast
    def enter(self, vehicles: Vehicles, key: Tensor, episode: Tensor) -> Entered:
        """The start of episodes: the initial scene and the memory.

        A traffic that sets visibilities or desired speeds itself overrides this method.

        Args:
            vehicles: the scene so far.
            key, episode: the episodes' keys and numbers, [N] int64.
        """
        # What is drawn at the start has a key of its own, apart from the draws of the steps.
        memory = self.fresh_memory(vehicles, absorb(key, 0))
        return vehicles, new_tensordict(memory, len(key))


class Overlay(TrafficModule):
    """A traffic module that does not move vehicles itself but rewrites ``moved``.

    Subclasses implement :meth:`rewrite` instead of :meth:`TrafficModule.move`.
    """

    heeds_lane_ends = True  # as far as the model below does

    def rewrite(
        self,
        vehicles: Vehicles,
        moved: Vehicles,
        memory: Memory,
        key: Tensor,
        step: Tensor,
    ) -> Moved:
        """The new ``moved``, and the memory to keep; arguments as in :meth:`TrafficModule.move`."""
        raise NotImplementedError

    def _call(self, state: TensorDictBase, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        vehicles = Vehicles.of(state.get(keys.VEHICLES))
        # What the model and the overlays before this one made of the step.
        moved = Vehicles.of(state.get(keys.MOVED))
        return self.rewrite(vehicles, moved, memory, key, step)


class TrafficParts(TrafficModule):
    """Base of traffics made of several, each with its own memory under its name.

    Road and stream are the first's.
    """

    def __init__(self, parts: Mapping[str, TrafficModule]) -> None:
        # All parts drive on one road with one family of random numbers.
        first = next(iter(parts.values()))
        super().__init__(first.road, first.stream)
        # A ModuleDict, so that to(device) and state_dict() reach the parts.
        self.parts = nn.ModuleDict(parts)
        self.rows_must_stay = any(part.rows_must_stay for part in parts.values())
        self.heeds_lane_ends = all(part.heeds_lane_ends for part in parts.values())
        self.memory_fields = {name: part.memory_fields for name, part in parts.items()}

    def named_parts(self) -> list[tuple[str, TrafficModule]]:
        """Names and parts, in order."""
        return cast("list[tuple[str, TrafficModule]]", list(self.parts.items()))


class TrafficSequential(TrafficParts):
    """A base model followed by overlays.

    Args:
        parts: name to module, the base model first. Road, stream and visibility are the first
            one's.
        drivers: with which the native kernel drives as these parts do; None: it cannot.

    Raises:
        UserError: the base model plays recordings.
    """

    def __init__(self, parts: dict[str, TrafficModule], drivers: Drivers | None = None) -> None:
        super().__init__(parts)
        self._drivers = drivers
        _, base = self.named_parts()[0]
        if base.own_roads:
            raise UserError(
                "overlays behind replayed traffic: they go where they went; lay faults over a "
                "model."
            )
        # The base model alone says how its lane changes are seen.
        self.visibility = base.visibility

    def native_drivers(self) -> Drivers | None:
        """Those that it was made with."""
        return self._drivers

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Run the parts in order."""
        memories = memory_of(tensordict)
        new_memories = {}
        for name, part in self.named_parts():
            # Each part sees its own memory, and what the parts before it made of ``moved``.
            tensordict.set(keys.TRAFFIC, memory_of(memories, name))
            part(tensordict)
            new_memories[name] = tensordict.get(keys.TRAFFIC)
        n = tensordict.batch_size[0]
        return tensordict.set(keys.TRAFFIC, new_tensordict(new_memories, n))

    def enter(self, vehicles: Vehicles, key: Tensor, episode: Tensor) -> Entered:
        """The vehicles after the parts' :meth:`TrafficModule.enter`, and the memories by name."""
        memories = {}
        # In order: a part sees the desired speeds and visibilities that the parts before it set.
        for name, part in self.named_parts():
            vehicles, memories[name] = part.enter(vehicles, key, episode)
        return vehicles, new_tensordict(memories, len(key))
