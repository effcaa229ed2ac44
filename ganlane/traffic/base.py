"""What every traffic model is: a TensorDictModule that moves the other vehicles by 0.1 s."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ganlane import keys
from ganlane.keys import PHYSICS_STEP_S
from ganlane.parameters.driving import Visibility
from ganlane.runtime import compiled
from ganlane.sim.random import Stream, absorb, episode_key
from ganlane.sim.road import Road
from ganlane.sim.scenes import Scenes
from ganlane.sim.vehicles import Vehicles

#: Name to (trailing shape after [N, M], dtype); the dtype None stands for the run's float type.
MemoryFields = Mapping[str, tuple[tuple[int, ...], torch.dtype | None]]


def memory_of(tensordict: TensorDictBase) -> TensorDictBase:
    """``traffic`` of ``tensordict``; empty where it is missing, since TorchRL drops empty TensorDicts on the way."""
    memory = tensordict.get(keys.TRAFFIC, None)
    return TensorDict({}, batch_size=tensordict.batch_size) if memory is None else memory


def _put(tensordict: TensorDictBase, key: str, fields: dict[str, Tensor]) -> None:
    """``tensordict[key] = fields`` without the checks, which cost as much as a step of a small batch."""
    nested = TensorDict._new_unsafe(fields, batch_size=tensordict.batch_size)
    tensordict._set_str(key, nested, validated=True, inplace=False, non_blocking=False)


class TrafficModule(TensorDictModuleBase):
    """Base of all traffic models.

    In keys: ``vehicles`` (the state at t, never written), ``traffic`` (the module's memory), ``seed``,
    ``episode``, ``step`` ([N] int64); ``episode_key`` too, where the caller has worked it out. Out keys: ``moved``
    (the same fields as ``vehicles``, the others at t + 0.1 s) and ``traffic``. Index 0 is the ego: what the module
    writes there is overwritten by the environment. Numbers of vehicles that are not valid may be anything finite.
    Randomness comes from :mod:`ganlane.sim.random` and the counters alone.

    A model of your own needs one method, :meth:`move`; one with a memory also names :attr:`memory_fields` and
    fills them in :meth:`fresh_memory`::

        class Cruise(TrafficModule):
            def move(self, vehicles, memory, key, step):
                return vehicles.with_(x=vehicles.x + vehicles.speed * self.dt), memory

    Args:
        road: lanes and lane width, fixed for the module's life.
        stream: family of episodes that the random numbers belong to (:class:`ganlane.sim.random.Stream`).
    """

    in_keys = [keys.VEHICLES, keys.TRAFFIC, keys.SEED, keys.EPISODE, keys.STEP]  # noqa: RUF012
    out_keys = [keys.MOVED, keys.TRAFFIC]  # noqa: RUF012

    #: How the vehicles of this model show their lane changes to others; where that differs from episode to episode
    #: ``VISIBILITY_OF_EPISODE``, which :meth:`enter` replaces.
    visibility: int = Visibility.SIGNALLED
    #: Whether lanes and lane width differ from row to row (:meth:`road_of`).
    own_roads: bool = False
    #: Whether a running episode has to keep its row of the batch, since the module holds something per row outside
    #: ``traffic`` (a foreign simulator). New episodes then show by their (seed, episode) with step 0.
    rows_must_stay: bool = False
    #: Per-vehicle memory; empty for a model without any.
    memory_fields: MemoryFields = {}  # noqa: RUF012

    def __init__(self, road: Road | None = None, stream: int = Stream.TRAIN) -> None:
        super().__init__()
        self.road = road or Road()
        self.stream = int(stream)
        self.dt = PHYSICS_STEP_S

    def move(self, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor) -> tuple[Vehicles, dict]:
        """The vehicles at t + 0.1 s, and the memory to keep.

        Args:
            vehicles: at t, fields [N, M].
            memory: name to tensor [N, M, ...].
            key: the episodes' keys [N] int64, for random numbers.
            step: physics steps since the start of the episode, [N] int64.
        """
        raise NotImplementedError

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> dict[str, Tensor]:
        """Memory as if every vehicle had just entered; ``key`` [N] gives random traits."""
        return {}

    def road_of(self, key: Tensor, dtype: torch.dtype) -> Road:
        """The road of the episodes with ``key`` [N]."""
        return self.road

    def steps_of(self, key: Tensor) -> Tensor | None:
        """Physics steps [N] int64 after which an episode ends (``scene_end``); None: never."""
        return None

    def scenes(self, vehicles: int, ego_visibility: int, ego_desired_speed_mps: float) -> Scenes | None:
        """Where the episodes of this traffic start; None: wherever the environment says."""
        return None

    def compile_graphs(self) -> None:
        """Compile what is a pure function on tensors (``env.compile=true``); here :meth:`move`.

        A model whose :meth:`move` asks for the value of a tensor overrides this and compiles the parts between.
        """
        self.move = compiled(self.move)  # type: ignore[method-assign]

    # Below: TensorDicts in and out, so that models can be chained and stored.

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``moved`` and ``traffic``."""
        vehicles = Vehicles.of(tensordict.get(keys.VEHICLES))
        memory = dict(memory_of(tensordict).items())
        key = tensordict.get(keys.EPISODE_KEY, None)
        if key is None:
            key = episode_key(self.stream, tensordict.get(keys.SEED), tensordict.get(keys.EPISODE))
        moved, memory = self._call(tensordict, vehicles, memory, key)
        _put(tensordict, keys.MOVED, moved.as_dict())
        _put(tensordict, keys.TRAFFIC, memory)
        return tensordict

    def _call(
        self, tensordict: TensorDictBase, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor
    ) -> tuple[Vehicles, dict[str, Tensor]]:
        return self.move(vehicles, memory, key, tensordict.get(keys.STEP))

    def init_memory(self, vehicles: Vehicles, who: Tensor, key: Tensor) -> TensorDict:
        """Memory [N] with leaves [N, M, ...] for the vehicles that enter (``who`` [N, M] bool).

        The environment keeps the old memory of the others, so a module may fill all entries.
        """
        return TensorDict(self.fresh_memory(vehicles, key), batch_size=[vehicles.x.shape[0]])

    def enter(self, vehicles: Vehicles, key: Tensor, episode: Tensor) -> tuple[Vehicles, TensorDictBase]:
        """The start of the episodes with ``key`` [N]: the vehicles as this traffic has them, and its memory.

        Here the vehicles stay as they are and :meth:`init_memory` fills the memory. A traffic that changes what a
        scene leaves to it (who is seen how, how fast a driver wants to go) overrides this method.

        Args:
            vehicles: the first scene, fields [N, M].
            key: the episodes' keys [N] int64.
            episode: their numbers [N] int64.
        """
        return vehicles, self.init_memory(vehicles, torch.ones_like(vehicles.valid), absorb(key, 0))

    def memory_spec(self, n: int, m: int, dtype: torch.dtype = torch.float32) -> dict:
        """Nested name -> (shape, dtype) of the memory of ``n`` rows of ``m`` vehicles."""
        return {name: ((n, m, *shape), kind or dtype) for name, (shape, kind) in self.memory_fields.items()}
