"""Several traffic models side by side: every episode belongs to one of them, by its number.

So an agent that trains on a mixture meets all parts in the shares that were asked for, and an episode is the same in
every batch. Each part computes its own rows alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from ganlane import keys
from ganlane.errors import UserError
from ganlane.sim.lanes import VISIBILITY_OF_EPISODE
from ganlane.sim.random import episode_key
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import TrafficModule, memory_of

#: Where the rows of a part change in number, compiled graphs get them padded to so many different sizes at most.
_SIZES = 16


def interleaved(shares: Mapping[str, int]) -> list[str]:
    """Whose turn it is in a period of ``sum(shares)`` episodes, spread as evenly as it goes.

    ``{a: 2, b: 1}`` gives a, b, a: in every episode each part gains its share, and the one that is owed most (the
    first of several) goes and pays the sum.
    """
    owed, turns = dict.fromkeys(shares, 0), []
    for _ in range(sum(shares.values())):
        for name, share in shares.items():
            owed[name] += share
        turn = max(owed, key=lambda name: owed[name])
        owed[turn] -= sum(shares.values())
        turns.append(turn)
    return turns


class Rows(NamedTuple):
    """The rows of a batch that belong to a part: ``number`` of them, then repetitions that fill up a size.

    ``source`` [N] tells for every row of the batch which of the part's it is; ``number`` where it is not the part's.
    """

    picked: Tensor
    number: int
    source: Tensor

    @property
    def own(self) -> Tensor:
        """The rows without the repetitions."""
        return self.picked[: self.number]


class Layout(NamedTuple):
    """Whose rows are which: part of every row [N], rows by part, and the order that brings them back together."""

    part: Tensor
    rows: tuple[Rows, ...]
    back: Tensor


class Compact(NamedTuple):
    """A tensor of the memory in a part's rows alone, beside the one of the whole batch that it was spread to."""

    whole: Tensor
    version: int | None
    picked: Tensor
    part: Tensor


def _version(tensor: Tensor) -> int | None:
    """Counts writes into a tensor; None where torch does not count them."""
    return None if tensor.is_inference() else tensor._version


class MixedTraffic(TrafficModule):
    """``traffic=mixed``: parts and their shares of the episodes.

    Episode ``e`` belongs to the part whose turn is ``e`` modulo the sum of the shares (:func:`interleaved`). Where
    the batch size is a multiple of that sum, every row keeps its part. Memory: the parts' memories by name; in rows
    that are not its own a part's memory is zero.

    A part gets its rows of vehicles, memory and counters, and computes what it would compute alone: bit for bit where
    the model is the same at every batch size, as rule-driven ones are.

    Generated traffic remembers much and renews little of it in a step, so copies of the memory are kept to what is
    new: a tensor that a part returns as it was given stands for the one of the whole batch, and what was spread to
    the whole batch is not gathered again in the next step.

    Args:
        parts: models by name, of one road and stream.
        shares: whole numbers above 0 by the same names.

    Raises:
        UserError: no parts, shares that are not theirs, or a part that plays recordings.
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
        first = next(iter(parts.values()))
        super().__init__(first.road, first.stream)
        if any(part.stream != first.stream or part.road != first.road for part in parts.values()):
            raise UserError("traffic.shares: the parts have different roads or streams; build all with the same.")
        self.parts = nn.ModuleDict({_key(name): part for name, part in parts.items()})
        self.shares = {_key(name): shares[name] for name in parts}
        kinds = {int(part.visibility) for part in parts.values()}
        self.visibility = kinds.pop() if len(kinds) == 1 else VISIBILITY_OF_EPISODE
        numbers = {name: number for number, name in enumerate(self.shares)}
        turns = torch.tensor([numbers[name] for name in interleaved(self.shares)])
        self.register_buffer("turns", turns, persistent=False)
        self.rows_must_stay = any(part.rows_must_stay for part in parts.values())
        self.compiled = False
        self._layout: Layout | None = None
        self._compact: dict[int, Compact] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_layout": None, "_compact": {}}

    def named_parts(self) -> list[tuple[str, TrafficModule]]:
        """Names and parts, in the order of the shares."""
        return [(name, cast(TrafficModule, part)) for name, part in self.parts.items()]

    def part_of(self, episode: Tensor) -> Tensor:
        """Index of the part that each ``episode`` [N] belongs to."""
        turns = cast(Tensor, self.turns)
        return turns[episode % len(turns)]

    def layout(self, episode: Tensor) -> Layout:
        """The :class:`Layout` of a batch; on a GPU asking for it waits for the queue once a step."""
        part = self.part_of(episode)
        if self._layout is None or not _same(self._layout.part, part):
            rows = tuple(self._rows(part, index) for index in range(len(self.shares)))
            self._layout = Layout(part, rows, torch.cat([each.own for each in rows]).argsort())
        return self._layout

    def _rows(self, part: Tensor, index: int) -> Rows:
        own = (part == index).nonzero()[:, 0]
        count, batch = len(own), len(part)
        usual = batch * list(self.shares.values())[index] / sum(self.shares.values())
        source = torch.full_like(part, count).index_copy_(0, own, torch.arange(count, device=part.device))
        if not self.compiled or count in (0, usual):
            return Rows(own, count, source)
        # A graph is made for every number of rows, which takes a minute.
        size = max(8, batch // _SIZES)
        padding = own[:1].expand(-count % size)
        return Rows(torch.cat((own, padding)), count, source)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``moved`` and ``traffic``, each part its rows."""
        vehicles, memories = Vehicles.of(tensordict.get(keys.VEHICLES)), memory_of(tensordict)
        counters = {name: tensordict.get(name) for name in (keys.SEED, keys.EPISODE, keys.STEP)}
        key = tensordict.get(keys.EPISODE_KEY, None)
        own_key = episode_key(self.stream, counters[keys.SEED], counters[keys.EPISODE]) if key is None else key
        counters[keys.EPISODE_KEY] = own_key
        layout, none = self.layout(counters[keys.EPISODE]), TensorDict({}, batch_size=tensordict.batch_size)
        given, moved, kept = [], [], {}
        compact: dict[int, Compact] = {}
        for (name, part), rows in zip(self.named_parts(), layout.rows):
            memory = memories.get(name, none)
            if rows.number == 0:
                kept[name] = memory
                continue
            fields = _picked(vehicles, rows)
            seen = {each: value.index_select(0, rows.picked) for each, value in counters.items()}
            seen[keys.VEHICLES] = _nested(fields.as_dict(), rows)
            own = Gathered(rows, self._compact)
            seen[keys.TRAFFIC] = own.gather(memory)
            after = part(_nested(seen, rows))
            given.append(fields)
            moved.append(Vehicles.of(after.get(keys.MOVED)))
            kept[name] = own.spread(memory_of(after), compact)
        self._compact = compact
        everybody = _together(vehicles, given, moved, layout)
        tensordict.set(keys.MOVED, TensorDict._new_unsafe(everybody.as_dict(), batch_size=tensordict.batch_size))
        tensordict.set(keys.TRAFFIC, TensorDict._new_unsafe(kept, batch_size=tensordict.batch_size))
        return tensordict

    def enter(self, vehicles: Vehicles, key: Tensor, episode: Tensor) -> tuple[Vehicles, TensorDictBase]:
        """Every row as its part has it; memory of the other parts is zero there."""
        (n, m), dtype = vehicles.x.shape, vehicles.x.dtype
        layout, given, entered, memories = self.layout(episode), [], [], {}
        for (name, part), rows in zip(self.named_parts(), layout.rows):
            if rows.number == 0:
                memories[name] = _zeros(part.memory_spec(n, m, dtype), n, vehicles.x.device)
                continue
            fields = _picked(vehicles, rows)
            seen = fields.visibility
            shown = torch.where(seen == VISIBILITY_OF_EPISODE, int(part.visibility), seen)
            own, memory = part.enter(fields.with_(visibility=shown), key[rows.picked], episode[rows.picked])
            given.append(fields)
            entered.append(own)
            memories[name] = Gathered(rows, {}).spread(memory, {})
        return _together(vehicles, given, entered, layout), TensorDict._new_unsafe(
            memories, batch_size=torch.Size([n])
        )

    def init_memory(self, vehicles: Vehicles, who: Tensor, key: Tensor) -> TensorDict:
        """Not to be had: whose an episode is follows from its number (:meth:`enter`)."""
        raise UserError("traffic=mixed: its memory begins with an episode's number; call enter() in place of this.")

    def memory_spec(self, n: int, m: int, dtype: torch.dtype = torch.float32) -> dict[str, Any]:
        """The parts' specs, by name."""
        return {name: part.memory_spec(n, m, dtype) for name, part in self.named_parts()}

    def compile_graphs(self) -> None:
        """Compile every part; from now on the rows of a part come in few different numbers."""
        self.compiled, self._layout, self._compact = True, None, {}
        for _, part in self.named_parts():
            part.compile_graphs()


class Gathered:
    """The memory of a part: from the whole batch to its rows, and back.

    Args:
        rows: the part's.
        known: tensors of the whole batch that were spread in the last step, by identity.
    """

    def __init__(self, rows: Rows, known: Mapping[int, Compact]) -> None:
        self.rows, self.known = rows, known
        self.given: dict[int, Compact] = {}

    def gather(self, memory: TensorDictBase) -> TensorDictBase:
        """``memory`` of the whole batch in the part's rows."""
        return _nested({name: self._gathered(value) for name, value in memory.items()}, self.rows)

    def _gathered(self, whole: Tensor | TensorDictBase) -> Tensor | TensorDictBase:
        if not isinstance(whole, Tensor):
            return self.gather(whole)
        found = self.known.get(id(whole))
        same = found is not None and found.whole is whole and found.picked is self.rows.picked
        if found is None or not same or found.version is None or found.version != _version(whole):
            picked = self.rows.picked
            found = Compact(whole, _version(whole), picked, whole.index_select(0, picked))
        self.given[id(found.part)] = found
        return found.part

    def spread(self, memory: TensorDictBase, compact: dict[int, Compact]) -> TensorDictBase:
        """The part's ``memory`` in the whole batch, zero elsewhere; ``compact`` notes which is which."""
        named = {name: self._spread(value, compact) for name, value in memory.items()}
        return TensorDict._new_unsafe(named, batch_size=self.rows.source.shape)

    def _spread(self, part: Tensor | TensorDictBase, compact: dict[int, Compact]) -> Tensor | TensorDictBase:
        if not isinstance(part, Tensor):
            return self.spread(part, compact)
        found = self.given.get(id(part))
        if found is None or found.part is not part:
            # One row of zeros at the end is what all other rows get: a third faster than zeros and then copies.
            zeros = part.new_zeros((1, *part.shape[1:]))
            whole = torch.cat((part[: self.rows.number], zeros)).index_select(0, self.rows.source)
            found = Compact(whole, _version(whole), self.rows.picked, part)
        compact[id(found.whole)] = found
        return found.whole


def _key(name: str) -> str:
    """A part's name in the memory: an import path has dots, which separate nested names elsewhere."""
    return name.replace(".", "_")


def _same(one: Tensor, other: Tensor) -> bool:
    return one.device == other.device and torch.equal(one, other)


def _nested(fields: Mapping[str, Any], rows: Rows) -> TensorDict:
    return TensorDict._new_unsafe(dict(fields), batch_size=torch.Size([len(rows.picked)]))


def _picked(vehicles: Vehicles, rows: Rows) -> Vehicles:
    return Vehicles(*(value.index_select(0, rows.picked) for value in vehicles))


def _together(vehicles: Vehicles, given: list[Vehicles], done: list[Vehicles], layout: Layout) -> Vehicles:
    """The parts' rows as one batch; a field that no part has touched is that of ``vehicles``."""
    counts = [rows.number for rows in layout.rows if rows.number]

    def field(at: int) -> Tensor:
        if all(after[at] is before[at] for before, after in zip(given, done)):
            return vehicles[at]
        return torch.cat([after[at][:count] for after, count in zip(done, counts)]).index_select(0, layout.back)

    return Vehicles(*(field(at) for at in range(len(vehicles))))


def _zeros(spec: Mapping[str, Any], n: int, device: torch.device) -> TensorDict:
    """An empty memory as :meth:`TrafficModule.memory_spec` describes it."""
    named = {
        name: _zeros(value, n, device)
        if isinstance(value, Mapping)
        else torch.zeros(value[0], dtype=value[1], device=device)
        for name, value in spec.items()
    }
    return TensorDict._new_unsafe(named, batch_size=torch.Size([n]))
