"""HighwayEnv as TorchRL sees it: specs, reset, step."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from ganlane import keys
from ganlane.env.decision import Decision, Recorder
from ganlane.env.physics import EpisodeParameters, Physics, Rules, Substep, outcome
from ganlane.env.state import DONE_FLAGS, done_spec, fresh_ego, no_events, pack, state_spec
from ganlane.errors import UserError
from ganlane.keys import EGO_INDEX
from ganlane.sim.ego import EgoParameters
from ganlane.sim.idm import TABLE_V, IdmParameters
from ganlane.sim.random import absorb, episode_key
from ganlane.sim.road import Road
from ganlane.sim.spawn import SpawnParameters, spawn
from ganlane.sim.steering import STEERING, SteeringParameters
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import TrafficModule


class HighwayEnv(EnvBase):
    """N highways with one ego each.

    Args:
        traffic: moves the other vehicles; its road is the environment's.
        num_envs: N, the batch size.
        vehicles: M, the ego included.
        spawn_parameters: Table II.
        ego: the ego's lane changes and visibility.
        episode: decision period, goal and time-out.
        idm, steering: the ego's car following (Table V) and steering.
        stream: family of episodes (training, selection, report); by default, and at most, the traffic's.
        seed: base of the random numbers; ``set_seed`` changes it for the next full reset.
        first_episode: row i starts with episode ``first_episode + i`` and goes on in steps of N.
        device, dtype: where and in which float type to simulate.
        recycle: put vehicles that the ego leaves behind back in front of it, and the reverse, after every decision
            (:mod:`ganlane.sim.recycle`), so that the road never empties.

    An episode is (stream, seed, episode) and does not depend on the batch. ``reset(td)`` with ``seed`` and
    ``episode`` [N] in ``td`` and no ``_reset`` mask runs exactly those episodes. :attr:`recorder`, if set, is called
    after every physics step.

    Raises:
        UserError: the vehicles do not fit on the road, the decision period is not a multiple of 0.1 s, or the
            traffic belongs to another stream.
    """

    batch_locked = True

    def __init__(
        self,
        traffic: TrafficModule,
        num_envs: int = 1,
        vehicles: int = 9,
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
        recycle: bool = False,
    ) -> None:
        super().__init__(device=device or torch.device("cpu"), batch_size=torch.Size([num_envs]))
        self.traffic = traffic.to(self.device)
        self.road: Road = traffic.road
        self.spawn_parameters = spawn_parameters or SpawnParameters()
        self.ego = ego or EgoParameters()
        self.episode = episode or EpisodeParameters()
        self.vehicles, self.stream, self.dtype = vehicles, traffic.stream, dtype
        self.first_episode, self.recycle = first_episode, recycle
        self.recorder: Recorder | None = None
        self.physics = Physics(Rules(self.road, self.ego, self.episode, idm, steering))
        self.decision = Decision(self.traffic, self.physics)
        self._seed = seed
        #: Seed and episode [N] of the rows as they were last seen; automatic resets go on from there.
        self._last: tuple[Tensor, Tensor] | None = None
        self.episode.check()
        if stream is not None and int(stream) != traffic.stream:
            raise UserError(
                f"stream={int(stream)}: the traffic was built for stream {traffic.stream}; give both the same one, "
                "or an episode would depend on two of them."
            )
        if isinstance(self.road.lanes, int):
            self.spawn_parameters.check(vehicles, self.road.lanes)
        self._make_specs()

    def _make_specs(self) -> None:
        n, device = self.batch_size[0], self.device
        memory = self.traffic.memory_spec(n, self.vehicles, self.dtype)
        self.observation_spec = state_spec(n, self.vehicles, self.dtype, memory).to(device)
        # A TransformedEnv hands on to a reset only what the state spec names; without the counters a reset that asks
        # for certain episodes would run the first ones.
        counters = {name: self.observation_spec[name].clone() for name in (keys.SEED, keys.EPISODE)}
        self.state_spec = Composite(counters, shape=(n,), device=device)
        self.action_spec = Categorical(3, shape=(n,), dtype=torch.int64, device=device)
        self.reward_spec = Unbounded(shape=(n, 1), dtype=self.dtype, device=device)
        self.done_spec = done_spec(n).to(device)

    def compile(self, **kwargs: Any) -> HighwayEnv:
        """Turn physics and traffic into compiled graphs, several small ones; returns the environment.

        Several times as fast from some hundred environments on, after up to a minute of compiling. Results are
        the same up to rounding, not bitwise. TorchRL's own version of this method, which ``compile=True`` to the
        constructor calls as well, makes one graph of a whole step; here that one is slower and compiles longer.

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

    def _episodes(self, tensordict: TensorDictBase | None) -> tuple[Tensor, Tensor]:
        """Seed and episode [N] of every row after this reset."""
        n = self.batch_size[0]
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if tensordict is not None and keys.EPISODE in tensordict:
            seed, last = tensordict.get(keys.SEED), tensordict.get(keys.EPISODE)
        elif mask is not None and self._last is not None:
            # An automatic reset hands over the mask alone: TorchRL strips the counters.
            seed, last = self._last
        else:
            seed = torch.full((n,), self._seed, dtype=torch.int64, device=self.device)
            return seed, self.first_episode + torch.arange(n, device=self.device)
        return seed, last if mask is None else torch.where(mask.reshape(n), last + n, last)

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: object) -> TensorDictBase:
        """All rows at the start of their episodes; EnvBase keeps those of the rows that were not asked for."""
        seed, episode = self._last = self._episodes(tensordict)
        key = episode_key(self.stream, seed, episode)
        vehicles = self._spawn(key)
        memory = self.traffic.init_memory(vehicles, torch.ones_like(vehicles.valid), absorb(key, 0))
        zero = torch.zeros(self.batch_size, dtype=self.dtype, device=self.device)
        rest = {keys.SEED: seed, keys.EPISODE: episode, keys.STEP: torch.zeros_like(seed)}
        rest |= {name: zero[:, None].bool() for name in DONE_FLAGS}
        return pack(vehicles, fresh_ego(zero), memory, no_events(zero), rest)

    def _spawn(self, key: Tensor) -> Vehicles:
        lanes, width = self.road.lanes, self.road.lane_width_m
        assert not isinstance(lanes, Tensor)
        assert not isinstance(width, Tensor)
        seen = (self.ego.visibility, self.traffic.visibility)
        return spawn(key, self.vehicles, lanes, float(width), self.spawn_parameters, self.dtype, *seen)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """One decision."""
        self._last = (tensordict.get(keys.SEED), tensordict.get(keys.EPISODE))
        vehicles, ego = Vehicles.of(tensordict.get(keys.VEHICLES)), dict(tensordict.get(keys.EGO).items())
        start, ordered = self.physics.begin(tensordict.get(keys.ACTION), vehicles, ego, tensordict.get(keys.STEP))
        key = episode_key(self.stream, *self._last)
        at, memory = self.decision.drive(tensordict, start, key, self.recorder)
        remembered = self.physics.remember(ego, start.vehicles.speed[:, EGO_INDEX], start.step, at, ordered)
        events, flags = outcome(at, ordered)
        vehicles = self._recycled(at) if self.recycle else at.vehicles
        rest = {
            keys.SEED: tensordict.get(keys.SEED),
            keys.EPISODE: tensordict.get(keys.EPISODE),
            keys.STEP: at.step,
            keys.REWARD: torch.zeros_like(remembered["distance"])[:, None],
            **flags,
        }
        return pack(vehicles, remembered, memory, events, rest)

    def _recycled(self, at: Substep) -> Vehicles:
        """The vehicles of the rows that go on, moved round the ego where it has left them behind."""
        return self.physics.recycle(at.vehicles).where(at.running, at.vehicles)
