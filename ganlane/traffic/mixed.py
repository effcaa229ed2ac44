"""Traffic that differs from episode to episode: models in shares, or one that is blind to the ego.

Which one an episode gets follows from its number or key, so it is the same in every batch.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.errors import UserError
from ganlane.native.drivers import Drivers, blind, mixed_drivers
from ganlane.settings.traffic import interleaved
from ganlane.sim.random import Purpose, absorb, uniform
from ganlane.sim.state import VISIBILITY_OF_EPISODE, Vehicles
from ganlane.traffic.base import (
    Entered,
    TrafficModule,
    TrafficParts,
    key_of,
    memory_of,
    new_tensordict,
    with_rows,
    zero_memory,
)

#: A part, its name before it, and its rows [R] of the batch.
RowsOfPart = tuple[str, TrafficModule, Tensor]


class MixedTraffic(TrafficParts):
    """``traffic=mixed``: parts and their shares of the episodes.

    Episode ``e`` belongs to the part at ``e`` modulo the sum of the shares (:func:`interleaved`).
    If the batch size is a multiple of that sum, every row keeps its part. Memory: the parts'
    memories by name; zero in rows of other parts.

    A part gets its rows of vehicles, memory and counters, and computes what it would compute alone:
    bit for bit where the model is the same at every batch size, as rule-driven ones are.

    Args:
        parts: models by name, of one road and stream.
        shares: whole numbers above 0 by the same names.

    Raises:
        UserError: no parts, shares of other names, or a part that plays recordings.
    """

    # [sum of the shares]: the index of the part whose turn it is.
    turns: Tensor

    def __init__(self, parts: Mapping[str, TrafficModule], shares: Mapping[str, int]) -> None:
        same_names = set(parts) == set(shares)
        if not parts or not same_names or min(shares.values()) < 1:
            raise UserError(
                f"traffic.shares={dict(shares)}: expected a whole number of at least 1 for each of "
                f"the parts ({', '.join(parts) or 'none'}); give for instance "
                "traffic.shares={idm_mobil: 1, gan: 1}."
            )
        # An import path as a name has dots, which separate nested names in a module.
        super().__init__({name.replace(".", "_"): part for name, part in parts.items()})
        for name, part in parts.items():
            if part.own_roads:
                raise UserError(
                    f"traffic.shares: {name} plays recordings on roads of its own and cannot be "
                    "mixed with others; leave it out."
                )
            if part.stream != self.stream or part.road != self.road:
                raise UserError(
                    "traffic.shares: the parts have different roads or streams; build all with the "
                    "same."
                )

        # One visibility for all, or each episode has that of its part (:meth:`enter`).
        visibilities = {int(part.visibility) for part in parts.values()}
        self.visibility = VISIBILITY_OF_EPISODE
        if len(visibilities) == 1:
            self.visibility = visibilities.pop()

        # Not saved: it follows from the shares.
        names = list(parts)
        turns = torch.tensor([names.index(name) for name in interleaved(shares)])
        self.register_buffer("turns", turns, persistent=False)
        self._shares = {name.replace(".", "_"): share for name, share in shares.items()}
        # Of the present decision: the keys of its episodes, and the rows of the parts.
        self._rows: tuple[Tensor, list[RowsOfPart]] | None = None

    def native_drivers(self) -> Drivers | None:
        """Those of the parts, in turns; None where the kernel cannot drive one of them."""
        parts = {name: part.native_drivers() for name, part in self.named_parts()}
        return mixed_drivers(parts, self._shares)

    def part_of(self, episode: Tensor) -> Tensor:
        """Index of the part that each ``episode`` [N] belongs to, [N] int64."""
        return self.turns[episode % len(self.turns)]

    def rows_of_parts(self, episode: Tensor) -> list[RowsOfPart]:
        """The parts that have rows in the batch, and their rows.

        On a GPU this waits for the queue once.

        Args:
            episode: number of the episode of every row, [N] int64.
        """
        part_of_row = self.part_of(episode)
        numbers = torch.arange(len(self.parts), device=episode.device)
        # How many rows each part has.
        sizes = (part_of_row[:, None] == numbers).sum(0).tolist()
        # Sorted by part: the rows of the first one, then those of the second, and so on.
        rows_of_part = part_of_row.argsort(stable=True).split(sizes)

        parts = []
        for (name, part), rows in zip(self.named_parts(), rows_of_part):
            if len(rows):
                parts.append((name, part, rows))
        return parts

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``moved`` and ``traffic``, each part its rows."""
        vehicles = tensordict.get(keys.VEHICLES)
        episode = tensordict.get(keys.EPISODE)
        # The steps of a decision share the tensor of the keys, which is made anew for the next.
        key = key_of(tensordict, self.stream)
        if self._rows is None or self._rows[0] is not key:
            self._rows = key, self.rows_of_parts(episode)

        inputs = {
            keys.SEED: tensordict.get(keys.SEED),
            keys.EPISODE: episode,
            keys.STEP: tensordict.get(keys.STEP),
            keys.EPISODE_KEY: key,
            keys.VEHICLES: vehicles,
        }
        memories = memory_of(tensordict)
        moved = vehicles
        new_memories = dict(memories.items())
        for name, part, rows in self._rows[1]:
            memory = memory_of(memories, name)
            of_all = new_tensordict({**inputs, keys.TRAFFIC: memory}, len(key))
            taken = of_all[rows]
            before = taken.get(keys.VEHICLES)
            output = part(taken)

            # Field by field, what the part has changed. `is`, not ==: a field that was only passed
            # on needs no write.
            changed = {
                field: value
                for field, value in output.get(keys.MOVED).items()
                if value is not before.get(field)
            }
            moved = with_rows(moved, rows, changed)
            new_memories[name] = with_rows(memory, rows, memory_of(output))

        tensordict.set(keys.MOVED, moved)
        return tensordict.set(keys.TRAFFIC, new_tensordict(new_memories, len(key)))

    def enter(self, vehicles: Vehicles, key: Tensor, episode: Tensor) -> Entered:
        """Every row by its part; the memory of the other parts is zero there."""
        n = len(key)
        together = new_tensordict(vehicles.as_dict(), n)
        memories = new_tensordict(zero_memory(self.memory_fields, vehicles.x), n)

        for name, part, rows in self.rows_of_parts(episode):
            # A traffic sees only its own rows of the scene.
            scene = vehicles.part(rows)

            # Here the part is known, so the placeholder becomes its visibility.
            of_episode = scene.visibility == VISIBILITY_OF_EPISODE
            visibility = torch.where(of_episode, int(part.visibility), scene.visibility)
            scene = scene.with_(visibility=visibility)

            entered, memory = part.enter(scene, key[rows], episode[rows])
            together = with_rows(together, rows, entered.as_dict())
            memories.set(name, with_rows(memories.get(name), rows, memory))

        return Vehicles.of(together), memories


class BlindTraffic(TrafficModule):
    """Any traffic model, blind to the ego in a share of the episodes, as replayed recordings are.

    In these episodes the model gets a state in which the ego is invalid: no vehicle brakes or waits
    for it. The environment is as ever: the ego hits others, is hit, and observes. Whether an
    episode is blind follows from (stream, seed, episode) alone. The memory is the model's.

    Args:
        model: the traffic.
        blind_share: of the episodes, 0 to 1.

    Raises:
        UserError: the model plays recordings.
    """

    def __init__(self, model: TrafficModule, blind_share: float) -> None:
        if model.own_roads:
            raise UserError(
                f"traffic.blind_share={blind_share:g} with replayed traffic: recorded vehicles see "
                "no ego anyway; leave it out."
            )
        super().__init__(model.road, model.stream)
        self.model = model
        self.blind_share = blind_share
        # For the rest it is as the model.
        self.visibility = model.visibility
        self.rows_must_stay = model.rows_must_stay
        self.heeds_lane_ends = model.heeds_lane_ends
        self.memory_fields = model.memory_fields

    def native_drivers(self) -> Drivers | None:
        """Those of the model, blind."""
        drivers = self.model.native_drivers()
        return None if drivers is None else blind(drivers, self.blind_share)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``moved`` and ``traffic`` of the model, which does not see hidden egos."""
        vehicles = tensordict.get(keys.VEHICLES)
        unseen = self.unseen(Vehicles.of(vehicles), key_of(tensordict, self.stream))

        # The copies are shallow: the state at t is not written to.
        seen = vehicles.copy()
        seen.set("valid", vehicles.get("valid") & ~unseen)
        inputs = tensordict.copy()
        inputs.set(keys.VEHICLES, seen)
        output = self.model(inputs)

        # What becomes of a hidden ego here does not matter: the environment overwrites it.
        tensordict.set(keys.MOVED, output.get(keys.MOVED))
        return tensordict.set(keys.TRAFFIC, output.get(keys.TRAFFIC))

    def unseen(self, vehicles: Vehicles, key: Tensor) -> Tensor:
        """The egos of blind episodes, bool [N, M].

        Args:
            vehicles: at any step, [N, M].
            key: of the episodes, [N] int64.
        """
        # Drawn before the first step, by a key of its own. In float64, so that the same episodes
        # are blind in runs of either float type.
        entering = absorb(key, 0)
        # [N, 1]: one number for each episode.
        u = uniform(entering, -1, 1, [Purpose.BLIND_EPISODE], torch.float64)[..., 0]
        is_blind = u < self.blind_share
        return is_blind & vehicles.is_ego()

    def enter(self, vehicles: Vehicles, key: Tensor, episode: Tensor) -> Entered:
        """As the model."""
        return self.model.enter(vehicles, key, episode)
