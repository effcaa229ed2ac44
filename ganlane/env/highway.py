"""HighwayEnv as TorchRL sees it: specs, reset, step."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from ganlane import keys
from ganlane.env.decision import Decision, Recorder, known_false
from ganlane.env.physics import Physics, Substep, outcome
from ganlane.env.rules import Rules
from ganlane.env.state import DONE_FLAGS, done_spec, fresh_ego, no_events, pack, state_spec
from ganlane.errors import UserError
from ganlane.keys import EGO_INDEX
from ganlane.parameters.driving import EgoParameters, IdmParameters, Visibility
from ganlane.parameters.episode import EpisodeParameters, SpawnParameters
from ganlane.sim.idm import TABLE_V
from ganlane.sim.random import Purpose, episode_key, uniform
from ganlane.sim.recycle import out_of_range
from ganlane.sim.road import Road, road_in
from ganlane.sim.scenes import RandomScenes, Scenes
from ganlane.sim.steering import STEERING, SteeringParameters
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import TrafficModule


class HighwayEnv(EnvBase):
    """N highways with one ego each.

    Args:
        traffic: moves the other vehicles; its road is the environment's.
        num_envs: N, the batch size.
        vehicles: M, the ego included; None: as many as ``scenes`` has, 9 without.
        spawn_parameters: Table II.
        ego: the ego's lane changes and visibility.
        episode: decision period, goal and time-out.
        idm, steering: the ego's car following (Table V) and steering.
        stream: family of episodes (training, selection, report); by default, and at most, the traffic's.
        seed: base of the random numbers; ``set_seed`` changes it for the next full reset.
        first_episode: row i starts with episode ``first_episode + i`` and goes on in steps of N.
        scenes: where the vehicles of an episode start; None: at random, by ``spawn_parameters``. It also says who is
            seen how (``visibility``).
        device, dtype: where and in which float type to simulate.
        recycle: put vehicles that the ego leaves behind back in front of it, and the reverse, after every decision
            (:mod:`ganlane.sim.recycle`), so that the road never empties.
        recycle_share: share of the episodes in which ``recycle`` applies, 0 to 1; which ones follows from their
            numbers. A mixture of roads that empty and roads that do not, to train on both.

    An episode is (stream, seed, episode) and does not depend on the batch. ``reset(td)`` with ``seed`` and
    ``episode`` [N] in ``td`` and no ``_reset`` mask runs exactly those episodes. With a mask the masked rows go on to
    their episode plus N, or to ``next_episode`` [N] in ``reset(td, next_episode=...)``, on the seed in ``td``.
    :attr:`recorder`, if set, is called after every physics step.

    Raises:
        UserError: the vehicles do not fit on the road or could not brake in time, the decision period is not a
            multiple of 0.1 s, the traffic belongs to another stream, or ``recycle_share`` is no share.
    """

    batch_locked = True

    def __init__(
        self,
        traffic: TrafficModule,
        num_envs: int = 1,
        vehicles: int | None = None,
        spawn_parameters: SpawnParameters | None = None,
        ego: EgoParameters | None = None,
        episode: EpisodeParameters | None = None,
        idm: IdmParameters = TABLE_V,
        steering: SteeringParameters = STEERING,
        stream: int | None = None,
        seed: int = 0,
        first_episode: int = 0,
        device: torch.device | str | None = None,
        dtype: torch.dtype = torch.float32,
        scenes: Scenes | None = None,
        recycle: bool = False,
        recycle_share: float = 1.0,
    ) -> None:
        super().__init__(device=device or torch.device("cpu"), batch_size=torch.Size([num_envs]))
        self.traffic = traffic.to(self.device)
        self.road: Road = traffic.road
        self.spawn_parameters = spawn_parameters or SpawnParameters()
        self.ego = ego or EgoParameters()
        self.episode = episode or EpisodeParameters()
        self.stream, self.dtype = traffic.stream, dtype
        self.scenes = scenes or self._own_scenes(9 if vehicles is None else vehicles)
        self.vehicles = self.scenes.vehicles
        self.first_episode, self.recycle, self.recycle_share = first_episode, recycle, recycle_share
        self.recorder: Recorder | None = None
        self.rules = Rules(self.road, self.ego, self.episode, idm, steering)
        self.physics = Physics()
        self._seed = seed
        #: Seed and episode [N] of the rows as they were last seen; automatic resets go on from there.
        self.last_episodes: tuple[Tensor, Tensor] | None = None
        self._check_parts(vehicles, stream)
        self._make_specs()

    def _check_parts(self, vehicles: int | None, stream: int | None) -> None:
        """Refuse parts that do not go together; ``vehicles`` and ``stream`` as the user gave them."""
        if stream is not None and int(stream) != self.stream:
            raise UserError(
                f"stream={int(stream)}: the traffic was built for stream {self.stream}; give both the same one, "
                "or an episode would depend on two of them."
            )
        if self.recycle and self.traffic.own_roads:
            raise UserError(
                "env.recycle=true with replayed traffic: recorded vehicles go where they went; leave it off."
            )
        if not 0.0 <= self.recycle_share <= 1.0:
            raise UserError(
                f"env.recycle_share={self.recycle_share:g}: expected a number from 0 to 1; give such a share."
            )
        if vehicles is not None and vehicles != self.vehicles:
            raise UserError(
                f"vehicles={vehicles}: the scene has {self.vehicles}, the ego included; leave this number out."
            )
        self.scenes.check(self.road, self.rules.idm)

    def _own_scenes(self, vehicles: int) -> Scenes:
        """The traffic's recorded scenes where it has any, else random ones."""
        seen = (Visibility.named(self.ego.visibility), self.traffic.visibility)
        recorded = self.traffic.scenes(vehicles, seen[0], self.spawn_parameters.ego_desired_speed_mps)
        return recorded or RandomScenes(self.road, vehicles, self.spawn_parameters, *seen)

    def _make_specs(self) -> None:
        n, device = self.batch_size[0], self.device
        memory = self.traffic.memory_spec(n, self.vehicles, self.dtype)
        self.observation_spec = state_spec(n, self.vehicles, self.dtype, memory, self.traffic.own_roads).to(device)
        # A TransformedEnv hands on to a reset only what the state spec names; without the counters a reset that asks
        # for certain episodes would run the first ones.
        counters = {name: self.observation_spec[name].clone() for name in (keys.SEED, keys.EPISODE)}
        self.state_spec = Composite(counters, shape=(n,), device=device)
        self.action_spec = Categorical(3, shape=(n,), dtype=torch.int64, device=device)
        self.reward_spec = Unbounded(shape=(n, 1), dtype=self.dtype, device=device)
        self.done_spec = done_spec(n).to(device)

    def compile(self, **kwargs: Any) -> HighwayEnv:
        """Turn physics and traffic into compiled graphs, several small ones; returns the environment.

        How much faster that is at which batch, docs/performance.md tells; the first steps take a minute or so of
        compiling. Results are the same up to rounding, not bitwise. ``HighwayEnv(compile=True)`` calls this method
        too: TorchRL's own, which makes one graph of a whole step, is overridden.

        Raises:
            UserError: there is no C++ compiler, or an argument of TorchRL's version is given.
        """
        if kwargs:
            raise UserError(f"HighwayEnv.compile() takes no arguments, not {', '.join(kwargs)}; call it without.")
        self.physics.compile()
        self.traffic.compile_graphs()
        return self

    def _set_seed(self, seed: int | None) -> None:
        self._seed = 0 if seed is None else int(seed)

    def _episodes(
        self, tensordict: TensorDictBase | None, next_episode: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Seed and episode [N] of every row after this reset; ``next_episode`` [N] counts in masked rows only."""
        n = self.batch_size[0]
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if tensordict is not None and keys.EPISODE in tensordict:
            seed, last = tensordict.get(keys.SEED), tensordict.get(keys.EPISODE)
        elif mask is not None and self.last_episodes is not None:
            # An automatic reset hands over the mask alone: TorchRL strips the counters.
            seed, last = self.last_episodes
        else:
            seed = torch.full((n,), self._seed, dtype=torch.int64, device=self.device)
            return seed, self.first_episode + torch.arange(n, device=self.device)
        if mask is None:
            return seed, last
        return seed, torch.where(mask.reshape(n), last + n if next_episode is None else next_episode, last)

    def _reset(
        self, tensordict: TensorDictBase | None, next_episode: Tensor | None = None, **kwargs: object
    ) -> TensorDictBase:
        """All rows at the start of their episodes; EnvBase keeps those of the rows that were not asked for."""
        seed, episode = self.last_episodes = self._episodes(tensordict, next_episode)
        key = episode_key(self.stream, seed, episode)
        vehicles, memory = self.traffic.enter(self.scenes(key, self.dtype).with_finite_padding(), key, episode)
        zero = torch.zeros(self.batch_size, dtype=self.dtype, device=self.device)
        rest = {keys.SEED: seed, keys.EPISODE: episode, keys.STEP: torch.zeros_like(seed)}
        rest |= {name: zero[:, None].bool() for name in DONE_FLAGS}
        if self.traffic.own_roads:
            road = self.traffic.road_of(key, self.dtype)
            rest[keys.ROAD] = TensorDict({"lanes": road.lanes, "lane_width_m": road.lane_width_m}, self.batch_size)
        return pack(vehicles, fresh_ego(zero), memory, no_events(zero), rest)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """One decision."""
        self.last_episodes = (tensordict.get(keys.SEED), tensordict.get(keys.EPISODE))
        key = episode_key(self.stream, *self.last_episodes)
        rules = self._rules_of(tensordict, key)
        vehicles, ego = Vehicles.of(tensordict.get(keys.VEHICLES)), dict(tensordict.get(keys.EGO).items())
        start, ordered = self.physics.begin(
            rules, tensordict.get(keys.ACTION), vehicles, ego, tensordict.get(keys.STEP)
        )
        at, memory = Decision(self.traffic, self.physics, rules).drive(tensordict, start, key, self.recorder)
        remembered = self.physics.remember(rules, ego, start.vehicles.speed[:, EGO_INDEX], start.step, at, ordered)
        events, flags = outcome(rules, at, ordered)
        rest = {
            keys.SEED: tensordict.get(keys.SEED),
            keys.EPISODE: tensordict.get(keys.EPISODE),
            keys.STEP: at.step,
            keys.REWARD: torch.zeros_like(remembered["distance"])[:, None],
            **flags,
        }
        if self.traffic.own_roads:
            rest[keys.ROAD] = tensordict.get(keys.ROAD)
        return pack(self._recycled(rules, at, key), remembered, memory, events, rest)

    def _rules_of(self, state: TensorDictBase, key: Tensor) -> Rules:
        """The rules of every row: replayed scenes have roads and an end of their own."""
        if not self.traffic.own_roads:
            return self.rules
        return self.rules._replace(road=road_in(state, self.road), scene_steps=self.traffic.steps_of(key))

    def _recycled(self, rules: Rules, at: Substep, key: Tensor) -> Vehicles:
        """The vehicles after a decision; in rows that go on moved round the ego where it has left them behind."""
        if not self.recycle or known_false(out_of_range(at.vehicles, rules.road).any()):
            return at.vehicles
        recycled = at.running
        if self.recycle_share < 1.0:
            chosen = uniform(key, -1, 1, [Purpose.RECYCLED_EPISODE], torch.float64)[..., 0].reshape(recycled.shape)
            recycled = recycled & (chosen < self.recycle_share)
        return self.physics.recycle(at.vehicles, rules.road, rules.idm).where(recycled, at.vehicles)
