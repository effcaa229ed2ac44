"""Traffic that differs from episode to episode: several models in shares, or a model that does not
see the ego.

Which one an episode gets follows from its number or key, so it is the same in every batch.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.errors import UserError
from ganlane.keys import EGO_INDEX
from ganlane.sim.random import Purpose, absorb, uniform
from ganlane.sim.state import VISIBILITY_OF_EPISODE, Vehicles
from ganlane.traffic.base import TrafficModule, TrafficParts, key_of, memory_of

#: Compiled graphs get the rows of a part padded, so that there are at most about this many sizes.
_SIZES = 16


def interleaved(shares: Mapping[str, int]) -> list[str]:
    """The part of each of ``sum(shares)`` successive episodes, spread as evenly as possible.

    ``{a: 2, b: 1}`` gives a, b, a: in every episode each part gains its share, the one with the
    most (the first of several) is chosen and pays the sum.
    """
    credit, turns = dict.fromkeys(shares, 0), []
    for _ in range(sum(shares.values())):
        for name, share in shares.items():
            credit[name] += share
        chosen = max(credit, key=lambda name: credit[name])
        credit[chosen] -= sum(shares.values())
        turns.append(chosen)
    return turns


class Rows(NamedTuple):
    """The rows of a batch that belong to a part: the first ``number`` of ``picked``, then
    repetitions as padding.

    ``source`` [N] is the index of every row of the batch among the part's; ``number`` for rows of
    other parts.
    """

    picked: Tensor
    number: int
    source: Tensor


class Layout(NamedTuple):
    """Part of every row [N], rows by part, and the order that restores the batch from the parts'
    rows.
    """

    part: Tensor
    rows: tuple[Rows, ...]
    back: Tensor


class Compact(NamedTuple):
    """A memory tensor of a part's rows, and the one of the whole batch that it was scattered to (at
    ``version``).
    """

    whole: Tensor
    version: int | None
    picked: Tensor
    part: Tensor


def _version(tensor: Tensor) -> int | None:
    """Counts writes into a tensor; None where torch does not count them."""
    return None if tensor.is_inference() else tensor._version


class MixedTraffic(TrafficParts):
    """``traffic=mixed``: parts and their shares of the episodes.

    Episode ``e`` belongs to the part at ``e`` modulo the sum of the shares (:func:`interleaved`).
    If the batch size is a multiple of that sum, every row keeps its part. Memory: the parts'
    memories by name; zero in rows of other parts.

    A part gets its rows of vehicles, memory and counters, and computes what it would compute alone:
    bit for bit where the model is the same at every batch size, as rule-driven ones are.

    Generated traffic has a large memory and renews little of it in a step, so only what is new is
    copied: a tensor that a part returns unchanged keeps its tensor of the whole batch, and what was
    scattered to the whole batch in one step is not gathered again in the next.

    Args:
        parts: models by name, of one road and stream.
        shares: whole numbers above 0 by the same names.

    Raises:
        UserError: no parts, shares of other names, or a part that plays recordings.
    """

    def __init__(self, parts: Mapping[str, TrafficModule], shares: Mapping[str, int]) -> None:
        if not parts or set(parts) != set(shares) or any(share < 1 for share in shares.values()):
            raise UserError(
                f"traffic.shares={dict(shares)}: expected a whole number of at least 1 for each of the parts "
                f"({', '.join(parts) or 'none'}); give for instance traffic.shares={{idm_mobil: 1, gan: 1}}."
            )
        for name, part in parts.items():
            if part.own_roads:
                raise UserError(
                    f"traffic.shares: {name} plays recordings on roads of its own and cannot be mixed with others; "
                    "leave it out."
                )
        # An import path as a name has dots, which separate nested names in a module.
        super().__init__({name.replace(".", "_"): part for name, part in parts.items()})
        if any(part.stream != self.stream or part.road != self.road for part in parts.values()):
            raise UserError(
                "traffic.shares: the parts have different roads or streams; build all with the same."
            )
        self.shares = {name.replace(".", "_"): shares[name] for name in parts}
        kinds = {int(part.visibility) for part in parts.values()}
        self.visibility = kinds.pop() if len(kinds) == 1 else VISIBILITY_OF_EPISODE
        turns = torch.tensor([list(self.shares).index(name) for name in interleaved(self.shares)])
        self.register_buffer("turns", turns, persistent=False)
        self.compiled = False
        self._layout: Layout | None = None
        self._compact: dict[int, Compact] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_layout": None, "_compact": {}}

    def part_of(self, episode: Tensor) -> Tensor:
        """Index of the part that each ``episode`` [N] belongs to."""
        turns = cast(Tensor, self.turns)
        return turns[episode % len(turns)]

    def layout(self, episode: Tensor) -> Layout:
        """The :class:`Layout` of a batch; on a GPU this waits for the queue once a step."""
        part, last = self.part_of(episode), self._layout
        if last is None or last.part.device != part.device or not torch.equal(last.part, part):
            rows = tuple(self._rows(part, index) for index in range(len(self.shares)))
            back = torch.cat([each.picked[: each.number] for each in rows]).argsort()
            last = self._layout = Layout(part, rows, back)
        return last

    def _rows(self, part: Tensor, index: int) -> Rows:
        own = (part == index).nonzero()[:, 0]
        count, batch = len(own), len(part)
        usual = batch * list(self.shares.values())[index] / sum(self.shares.values())
        source = torch.full_like(part, count).index_copy_(
            0, own, torch.arange(count, device=part.device)
        )
        if not self.compiled or count in (0, usual):
            return Rows(own, count, source)
        # A graph is compiled for every number of rows, which takes a minute.
        size = max(8, batch // _SIZES)
        return Rows(torch.cat((own, own[:1].expand(-count % size))), count, source)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``moved`` and ``traffic``, each part its rows."""
        vehicles, memories = Vehicles.of(tensordict.get(keys.VEHICLES)), memory_of(tensordict)
        counters = {name: tensordict.get(name) for name in (keys.SEED, keys.EPISODE, keys.STEP)}
        counters[keys.EPISODE_KEY] = key_of(tensordict, self.stream)
        layout = self.layout(counters[keys.EPISODE])
        before, after, kept = [], [], {}
        compact: dict[int, Compact] = {}
        for (name, part), rows in zip(self.named_parts(), layout.rows):
            memory = memory_of(memories, name)
            if rows.number == 0:
                kept[name] = memory
                continue
            fields = _pick(vehicles, rows)
            exchange = MemoryExchange(rows, self._compact)
            inputs = {each: value.index_select(0, rows.picked) for each, value in counters.items()}
            nested = {
                keys.VEHICLES: _nested(fields.as_dict(), rows),
                keys.TRAFFIC: exchange.gather(memory),
            }
            outputs = part(_nested({**inputs, **nested}, rows))
            before.append(fields)
            after.append(Vehicles.of(outputs.get(keys.MOVED)))
            kept[name] = exchange.scatter(memory_of(outputs), compact)
        self._compact = compact
        moved = _together(vehicles, before, after, layout)
        tensordict.set(
            keys.MOVED, TensorDict._new_unsafe(moved.as_dict(), batch_size=tensordict.batch_size)
        )
        tensordict.set(keys.TRAFFIC, TensorDict._new_unsafe(kept, batch_size=tensordict.batch_size))
        return tensordict

    def enter(
        self, vehicles: Vehicles, key: Tensor, episode: Tensor
    ) -> tuple[Vehicles, TensorDictBase]:
        """Every row by its part; the memory of the other parts is zero there."""
        (n, m), dtype = vehicles.x.shape, vehicles.x.dtype
        layout, before, after, memories = self.layout(episode), [], [], {}
        for (name, part), rows in zip(self.named_parts(), layout.rows):
            if rows.number == 0:
                memories[name] = _zeros(part.memory_spec(n, m, dtype), n, vehicles.x.device)
                continue
            fields = _pick(vehicles, rows)
            of_episode = fields.visibility == VISIBILITY_OF_EPISODE
            shown = torch.where(of_episode, int(part.visibility), fields.visibility)
            own, memory = part.enter(
                fields.with_(visibility=shown), key[rows.picked], episode[rows.picked]
            )
            before.append(fields)
            after.append(own)
            memories[name] = MemoryExchange(rows, {}).scatter(memory, {})
        together = _together(vehicles, before, after, layout)
        return together, TensorDict._new_unsafe(memories, batch_size=torch.Size([n]))

    def init_memory(self, vehicles: Vehicles, key: Tensor) -> TensorDict:
        """Not available: the part follows from the episode's number (:meth:`enter`)."""
        raise UserError(
            "traffic=mixed: its memory begins with an episode's number; call enter() in place of this."
        )

    def compile_graphs(self) -> None:
        """Compile every part; from now on the rows of a part come in few different numbers."""
        self.compiled, self._layout, self._compact = True, None, {}
        super().compile_graphs()


class MemoryExchange:
    """Gathers a part's memory from the whole batch to its rows, and scatters it back.

    Args:
        rows: the part's.
        known: tensors of the whole batch that were scattered in the last step, by identity.
    """

    def __init__(self, rows: Rows, known: Mapping[int, Compact]) -> None:
        self.rows, self.known = rows, known
        self.given: dict[int, Compact] = {}

    def gather(self, whole: Any) -> Any:
        """The memory (or a tensor of it) of the ``whole`` batch in the part's rows."""
        if not isinstance(whole, Tensor):
            return _nested({name: self.gather(value) for name, value in whole.items()}, self.rows)
        found = self.known.get(id(whole))
        same = found is not None and found.whole is whole and found.picked is self.rows.picked
        if found is None or not same or found.version is None or found.version != _version(whole):
            picked = self.rows.picked
            found = Compact(whole, _version(whole), picked, whole.index_select(0, picked))
        self.given[id(found.part)] = found
        return found.part

    def scatter(self, part: Any, compact: dict[int, Compact]) -> Any:
        """The ``part``'s memory (or a tensor of it) in the whole batch, else zero.

        ``compact`` collects pairs.
        """
        if not isinstance(part, Tensor):
            named = {name: self.scatter(value, compact) for name, value in part.items()}
            return TensorDict._new_unsafe(named, batch_size=self.rows.source.shape)
        found = self.given.get(id(part))
        if found is None or found.part is not part:
            # All other rows select one row of zeros at the end: a third faster than zeros and then
            # copies.
            zeros = part.new_zeros((1, *part.shape[1:]))
            whole = torch.cat((part[: self.rows.number], zeros)).index_select(0, self.rows.source)
            found = Compact(whole, _version(whole), self.rows.picked, part)
        compact[id(found.whole)] = found
        return found.whole


def _nested(fields: Mapping[str, Any], rows: Rows) -> TensorDict:
    return TensorDict._new_unsafe(dict(fields), batch_size=torch.Size([len(rows.picked)]))


def _pick(vehicles: Vehicles, rows: Rows) -> Vehicles:
    return Vehicles(*(value.index_select(0, rows.picked) for value in vehicles))


def _together(
    vehicles: Vehicles, before: list[Vehicles], after: list[Vehicles], layout: Layout
) -> Vehicles:
    """The parts' rows as one batch; a field that no part has changed is that of ``vehicles``."""
    counts = [rows.number for rows in layout.rows if rows.number]

    def joined(index: int) -> Tensor:
        if all(new[index] is old[index] for old, new in zip(before, after)):
            return vehicles[index]
        parts = [new[index][:count] for new, count in zip(after, counts)]
        return torch.cat(parts).index_select(0, layout.back)

    return Vehicles(*(joined(index) for index in range(len(vehicles))))


def _zeros(spec: Mapping[str, Any], n: int, device: torch.device) -> TensorDict:
    """A memory of zeros by :meth:`TrafficModule.memory_spec`."""
    named = {
        name: _zeros(value, n, device)
        if isinstance(value, Mapping)
        else torch.zeros(value[0], dtype=value[1], device=device)
        for name, value in spec.items()
    }
    return TensorDict._new_unsafe(named, batch_size=torch.Size([n]))


class BlindTraffic(TrafficModule):
    """Any traffic model, blind to the ego in a share of the episodes, as replayed recordings are.

    In these episodes the model gets a state in which the ego is invalid: no vehicle brakes or waits
    for it. The environment is as ever: the ego hits others, is hit, and observes. Whether an
    episode is blind follows from (stream, seed, episode) alone. Memory: the model's as ``model``,
    and ``unseen`` [N, M] bool, true for the ego of a blind episode.

    Args:
        model: the traffic.
        blind_share: of the episodes, 0 to 1.

    Raises:
        UserError: the share is out of range, or the model plays recordings.
    """

    def __init__(self, model: TrafficModule, blind_share: float) -> None:
        if not 0.0 <= blind_share <= 1.0:
            raise UserError(
                f"traffic.blind_share={blind_share:g}: expected a number from 0 to 1; give such a share."
            )
        if model.own_roads:
            raise UserError(
                f"traffic.blind_share={blind_share:g} with replayed traffic: recorded vehicles see no ego anyway; "
                "leave it out."
            )
        super().__init__(model.road, model.stream)
        self.model, self.blind_share = model, blind_share
        self.visibility, self.rows_must_stay = model.visibility, model.rows_must_stay

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``moved`` and ``traffic`` of the model, which does not see the ego of blind
        episodes.
        """
        memory, vehicles = memory_of(tensordict), tensordict.get(keys.VEHICLES)
        inputs = tensordict.copy()
        inputs.set(
            keys.VEHICLES,
            vehicles.copy().set("valid", vehicles.get("valid") & ~memory.get("unseen")),
        )
        inputs.set(keys.TRAFFIC, memory_of(memory, "model"))
        self.model(inputs)
        kept = {"model": memory_of(inputs), "unseen": memory.get("unseen")}
        tensordict.set(keys.MOVED, inputs.get(keys.MOVED))
        tensordict.set(keys.TRAFFIC, TensorDict._new_unsafe(kept, batch_size=tensordict.batch_size))
        return tensordict

    def unseen(self, vehicles: Vehicles, key: Tensor) -> Tensor:
        """The egos of blind episodes, bool [N, M].

        ``key`` as for :meth:`TrafficModule.fresh_memory`.
        """
        blind = (
            uniform(key, -1, 1, [Purpose.BLIND_EPISODE], torch.float64)[..., 0] < self.blind_share
        )
        return blind & (torch.arange(vehicles.x.shape[1], device=key.device) == EGO_INDEX)

    def enter(
        self, vehicles: Vehicles, key: Tensor, episode: Tensor
    ) -> tuple[Vehicles, TensorDictBase]:
        """As the model, with ``unseen``."""
        vehicles, memory = self.model.enter(vehicles, key, episode)
        named = {"model": memory, "unseen": self.unseen(vehicles, absorb(key, 0))}
        return vehicles, TensorDict._new_unsafe(named, batch_size=torch.Size([vehicles.x.shape[0]]))

    def init_memory(self, vehicles: Vehicles, key: Tensor) -> TensorDict:
        """As the model's, with ``unseen``."""
        named = {
            "model": self.model.init_memory(vehicles, key),
            "unseen": self.unseen(vehicles, key),
        }
        return TensorDict(named, batch_size=[vehicles.x.shape[0]])

    def memory_spec(self, n: int, m: int, dtype: torch.dtype = torch.float32) -> dict[str, Any]:
        """As the model's, with ``unseen``."""
        return {"model": self.model.memory_spec(n, m, dtype), "unseen": ((n, m), torch.bool)}

    def compile_graphs(self) -> None:
        """Compile the model."""
        self.model.compile_graphs()
