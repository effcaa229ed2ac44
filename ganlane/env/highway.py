"""HighwayEnv as a TorchRL environment.

Specs, reset, and step, by the tensor code or by the native kernel.
"""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from ganlane import keys
from ganlane.arguments import checked_arguments, seed_number, whole_number
from ganlane.env.physics import Physics, Recorder, Rules, known_false, outcome, run_decision
from ganlane.env.state import (
    ActionCheck,
    check_counter,
    done_spec,
    first_state,
    pack,
    state_spec,
    usable_device,
)
from ganlane.errors import UserError
from ganlane.native.library import torch_on_one_thread, why_not
from ganlane.native.tensors import Kernel, NativeScenes
from ganlane.parameters.driving import EgoParameters, IdmParameters, Visibility
from ganlane.parameters.episode import KERNELS, EpisodeParameters, SpawnParameters
from ganlane.sim.dynamics import STEERING, SteeringParameters
from ganlane.sim.idm import TABLE_V
from ganlane.sim.random import Purpose, episode_key, uniform
from ganlane.sim.scenes import Scenes
from ganlane.sim.spawn import RandomScenes, out_of_range
from ganlane.sim.state import Road, Vehicles, road_in
from ganlane.traffic.base import TrafficModule
from ganlane.traffic.idm_mobil import IdmMobilTraffic, IdmTraffic

#: An automatic reset draws the scenes of the ended rows alone where they are at most one in so
#: many.
FEW_ROWS = 4


class HighwayEnv(EnvBase):
    """N highways with one ego each.

    Args:
        traffic: moves the other vehicles; its road is the environment's.
        num_envs: N, the batch size.
        vehicles: M, the ego included; None: as many as ``scenes`` has, 9 without.
        spawn_parameters, episode: Table II; decision period, goal and time-out.
        ego, idm, steering: the ego's lane changes and visibility, car following (Table V) and
            steering.
        stream: family of episodes (training, selection, report); by default, and at most, the
            traffic's.
        seed: base of the random numbers; ``set_seed`` changes it for the next full reset.
        first_episode: row i starts with episode ``first_episode + i`` and continues in steps of N.
        scenes: initial vehicles of an episode and their visibility; None: at random, by
            ``spawn_parameters``.
        device, dtype: of the simulation's tensors.
        recycle: after every decision move vehicles far behind the ego to far ahead of it, and the
            reverse (:mod:`ganlane.sim.spawn`), so that the road never empties.
        recycle_share: share of the episodes in which ``recycle`` applies, 0 to 1, chosen by their
            numbers: a mixture of roads that empty and roads that do not.
        kernel: what drives a decision: ``torch``, the tensor code; ``native``, the kernel
            (:mod:`ganlane.native`), which does the same up to rounding, for rule-driven traffic on
            a CPU; ``auto``, the kernel where it can, and the tensor code while a recorder is set.

    An episode is (stream, seed, episode) and does not depend on the batch. ``reset(td)`` with
    ``seed`` and ``episode`` [N] in ``td`` and no ``_reset`` mask runs exactly those episodes. With
    a mask the masked rows continue with their episode plus N, or ``next_episode`` [N] of
    ``reset(td, next_episode=...)``, on the seed in ``td``. :attr:`recorder`, if set, is called
    after every physics step.

    Raises:
        UserError: the vehicles do not fit on the road or could not brake in time, the decision
            period is not a multiple of 0.1 s, the traffic belongs to another stream,
            ``recycle_share`` is no share, or the native kernel cannot do what is asked.
    """

    batch_locked = True

    @checked_arguments
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
        kernel: str = "torch",
    ) -> None:
        # The configuration's bounds lie within.
        whole_number("num_envs", num_envs, 1, 2**20)
        whole_number("first_episode", first_episode, 0, 2**62)
        if vehicles is not None:
            whole_number("vehicles", vehicles, 1, 1000)
        super().__init__(
            device=usable_device(device, dtype), batch_size=torch.Size([int(num_envs)])
        )
        self.traffic = traffic.to(self.device)
        self.road: Road = traffic.road
        self.spawn_parameters = spawn_parameters or SpawnParameters()
        self.ego = ego or EgoParameters()
        self.episode = episode or EpisodeParameters()
        self.stream, self.dtype = traffic.stream, dtype
        if scenes is None:
            # The traffic's own scenes if it has any, else random ones.
            count, spawn, seen = (
                9 if vehicles is None else vehicles,
                self.spawn_parameters,
                self.ego.visibility,
            )
            own = traffic.scenes(count, Visibility.named(seen), spawn.ego_desired_speed_mps)
            scenes = own or RandomScenes(
                self.road, count, spawn, Visibility.named(seen), traffic.visibility
            )
        self.scenes = scenes
        self.vehicles = self.scenes.vehicles
        self.first_episode, self.recycle, self.recycle_share = first_episode, recycle, recycle_share
        self.recorder: Recorder | None = None
        self.rules = Rules(self.road, self.ego, self.episode, idm, steering)
        self.physics = Physics()
        self._seed = seed_number(seed)
        #: Seed and episode [N] of the rows in the last call; automatic resets continue from there.
        self.last_episodes: tuple[Tensor, Tensor] | None = None
        self._check_parts(vehicles, stream)
        #: The native kernel; None: the tensor code drives.
        self.kernel = make_kernel(kernel, traffic, self.rules, self.vehicles, self.device, dtype)
        self._kernel_must = kernel == "native"
        self._native_scenes: NativeScenes | None = None
        if self.kernel is not None and type(self.scenes) is RandomScenes:
            self._native_scenes = NativeScenes(self.scenes, self.stream)
        self._check_action = ActionCheck(self.batch_size[0], self.device)
        self._make_specs()

    def _check_parts(self, vehicles: int | None, stream: int | None) -> None:
        """Raise :class:`UserError` for parts that do not fit.

        ``vehicles`` and ``stream`` as the user gave them.
        """
        if stream is not None and stream != self.stream:
            raise UserError(
                f"stream={stream}: the traffic was built for stream {self.stream}; give both the same one, "
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

    def _make_specs(self) -> None:
        n, device = self.batch_size[0], self.device
        memory = self.traffic.memory_spec(n, self.vehicles, self.dtype)
        self.observation_spec = state_spec(
            n, self.vehicles, self.dtype, memory, self.traffic.own_roads
        ).to(device)
        # A TransformedEnv passes to a reset only the keys of the state spec; without the counters a
        # reset to certain episodes would run the first ones.
        counters = {name: self.observation_spec[name].clone() for name in (keys.SEED, keys.EPISODE)}
        self.state_spec = Composite(counters, shape=(n,), device=device)
        self.action_spec = Categorical(keys.ACTIONS, shape=(n,), dtype=torch.int64, device=device)
        self.reward_spec = Unbounded(shape=(n, 1), dtype=self.dtype, device=device)
        self.done_spec = done_spec(n).to(device)

    def compile(self, **kwargs: Any) -> HighwayEnv:
        """Compile physics and traffic to several small graphs; returns the environment.

        Compiling takes about a minute in the first steps; docs/performance.md has the speeds.
        Results are equal up to rounding, not bitwise. Overrides TorchRL's method, which compiles a
        whole step to one graph; ``HighwayEnv(compile=True)`` calls this one too.

        Raises:
            UserError: there is no C++ compiler, or an argument of TorchRL's version is given.
        """
        if kwargs:
            raise UserError(
                f"HighwayEnv.compile() takes no arguments, not {', '.join(kwargs)}; call it without."
            )
        self.physics.compile()
        self.traffic.compile_graphs()
        return self

    def _set_seed(self, seed: int | None) -> None:
        self._seed = 0 if seed is None else seed_number(seed)

    def _episodes(
        self, tensordict: TensorDictBase | None, next_episode: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Seed and episode [N] of every row after this reset.

        ``next_episode`` [N] applies to masked rows only.
        """
        n = self.batch_size[0]
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if tensordict is not None and keys.EPISODE in tensordict:
            seed, last = (
                check_counter(name, tensordict.get(name, None), n)
                for name in (keys.SEED, keys.EPISODE)
            )
        elif mask is not None and self.last_episodes is not None:
            # In an automatic reset TorchRL passes the mask without the counters.
            seed, last = self.last_episodes
        else:
            seed = torch.full((n,), self._seed, dtype=torch.int64, device=self.device)
            return seed, self.first_episode + torch.arange(n, device=self.device)
        if mask is None:
            return seed, last
        following = (
            last + n if next_episode is None else check_counter("next_episode", next_episode, n)
        )
        return seed, torch.where(mask.reshape(n), following, last)

    def _reset(
        self,
        tensordict: TensorDictBase | None,
        next_episode: Tensor | None = None,
        **kwargs: object,
    ) -> TensorDictBase:
        """All rows at the start of their episodes; EnvBase keeps the rows that are not to be reset."""
        seed, episode = self.last_episodes = self._episodes(tensordict, next_episode)
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = None if mask is None else mask.reshape(-1)
        if self._native_scenes is not None:
            return self._native_scenes.start(seed, episode, mask)
        if mask is None or self.device.type != "cpu" or self.traffic.rows_must_stay:
            return self._start(seed, episode)
        rows = mask.nonzero()[:, 0]
        if not 0 < len(rows) <= len(mask) // FEW_ROWS:
            return self._start(seed, episode)
        # The other rows keep what they have: here they repeat one of those drawn, which is quicker
        # than their own.
        place = torch.zeros_like(seed)
        place[rows] = torch.arange(len(rows))
        started = self._start(seed[rows], episode[rows])[place]
        return started.set(keys.SEED, seed).set(keys.EPISODE, episode)

    def _start(self, seed: Tensor, episode: Tensor) -> TensorDictBase:
        """The first states of episodes [K]."""
        key = episode_key(self.stream, seed, episode)
        vehicles, memory = self.traffic.enter(
            self.scenes(key, self.dtype).with_finite_padding(), key, episode
        )
        state = first_state(seed, episode, vehicles, memory)
        if self.traffic.own_roads:
            road = self.traffic.road_of(key, self.dtype)
            state.set(
                keys.ROAD,
                TensorDict({"lanes": road.lanes, "lane_width_m": road.lane_width_m}, seed.shape),
            )
        return state

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """One decision."""
        seed, episode = tensordict.get(keys.SEED, None), tensordict.get(keys.EPISODE, None)
        if seed is None or episode is None:
            raise UserError(
                "step(): the state of no episode was given; call reset() first and step what it returns."
            )
        self.last_episodes = (seed, episode)
        action = self._check_action.form(tensordict.get(keys.ACTION, None))
        if self.kernel is not None and (self.recorder is None or self._kernel_must):
            return self._native_step(tensordict, action)
        self._check_action.values(action)
        key = episode_key(self.stream, seed, episode)
        rules = self.rules
        if self.traffic.own_roads:  # replayed scenes have their own roads and ends
            rules = rules._replace(
                road=road_in(tensordict, self.road), scene_steps=self.traffic.steps_of(key)
            )
        vehicles, ego = (
            Vehicles.of(tensordict.get(keys.VEHICLES)),
            dict(tensordict.get(keys.EGO).items()),
        )
        step = tensordict.get(keys.STEP)
        start, command = self.physics.begin(rules, action, vehicles, ego, step)
        end, memory = run_decision(
            self.traffic, self.physics, rules, tensordict, start, key, self.recorder
        )
        ego = self.physics.remember(rules, ego, start, end, command)
        events, flags = outcome(rules, end, command)
        reward = torch.zeros_like(ego["distance"])[:, None]  # which a transform writes
        rest = {
            keys.SEED: seed,
            keys.EPISODE: episode,
            keys.STEP: end.step,
            keys.REWARD: reward,
            **flags,
        }
        if self.traffic.own_roads:
            rest[keys.ROAD] = tensordict.get(keys.ROAD)
        vehicles = end.vehicles
        if self.recycle and not known_false(out_of_range(vehicles, rules.road).any()):
            # In running rows with recycling those left behind are moved.
            recycled = end.running & self._recycling_rows(key)
            vehicles = self.physics.recycle(vehicles, rules.road, rules.idm).where(
                recycled, vehicles
            )
        return pack(vehicles, ego, memory, events, rest)

    def _native_step(self, tensordict: TensorDictBase, action: Tensor) -> TensorDictBase:
        """One decision by the kernel."""
        assert self.kernel is not None
        if self.recorder is not None:
            raise UserError(
                "env.kernel=native shows no physics steps to a recorder; set env.kernel=torch."
            )
        if not self._kernel_must:
            say_once("env.kernel=auto: the native kernel")
        recycles = None
        if self.recycle:
            seed, episode = tensordict.get(keys.SEED), tensordict.get(keys.EPISODE)
            recycles = self._recycling_rows(episode_key(self.stream, seed, episode))
        try:
            after = self.kernel.decide(action, tensordict, recycles)
        except ValueError:
            self._check_action.values(action)  # says which
            raise
        return after.set(
            keys.REWARD, torch.zeros_like(after.get(keys.EGO).get("distance"))[:, None]
        )

    def _recycling_rows(self, key: Tensor) -> Tensor:
        """The rows [N] bool whose episodes, with ``key`` [N], recycle."""
        if self.recycle_share >= 1.0:
            return torch.ones_like(key, dtype=torch.bool)
        chosen = uniform(key, -1, 1, [Purpose.RECYCLED_EPISODE], torch.float64)[..., 0].reshape(
            key.shape
        )
        return chosen < self.recycle_share


# The native kernel


def threads_for(env: EnvBase) -> AbstractContextManager[None]:
    """:func:`~ganlane.native.library.torch_on_one_thread` for steps of an ``env`` that the kernel
    drives.
    """
    base: Any = env
    while hasattr(base, "base_env"):
        base = base.base_env
    return nullcontext() if getattr(base, "kernel", None) is None else torch_on_one_thread()


@lru_cache(maxsize=8)
def say_once(line: str) -> None:
    """Print a line to the standard error stream, the first time that it is given."""
    print(line, file=sys.stderr)


def make_kernel(
    wanted: str,
    traffic: TrafficModule,
    rules: Rules,
    vehicles: int,
    device: torch.device,
    dtype: torch.dtype,
) -> Kernel | None:
    """The kernel for ``wanted`` (``torch``, ``native`` or ``auto``); None: the tensor code drives.

    Raises:
        UserError: an unknown name, or ``native`` where the kernel cannot do what is asked or cannot
            be built.
    """
    if wanted not in KERNELS:
        raise UserError(
            f"env.kernel={wanted}: expected one of {', '.join(KERNELS)}; choose one of them."
        )
    if wanted == "torch":
        return None
    reason, missing = _why_not(traffic, rules, device, dtype), why_not()
    if wanted == "native" and (reason or missing):
        raise UserError(f"env.kernel=native {reason or missing}; set env.kernel=torch.")
    if reason:
        return None
    if missing:
        say_once(f"env.kernel=auto: the tensor code, since the native kernel {missing}")
        return None
    assert isinstance(traffic, IdmTraffic)
    mobil = traffic.mobil if isinstance(traffic, IdmMobilTraffic) else None
    return Kernel(rules.road, vehicles, rules.episode, rules.ego, rules.idm, rules.steering, mobil)


def _why_not(
    traffic: TrafficModule, rules: Rules, device: torch.device, dtype: torch.dtype
) -> str | None:
    """What the kernel cannot do of this, as the end of a sentence; None: it can do all."""
    if type(traffic) not in (IdmTraffic, IdmMobilTraffic):
        return f"drives the traffics idm and idm_mobil alone, not {type(traffic).__name__}"
    assert isinstance(traffic, IdmTraffic)
    if device.type != "cpu" or dtype != torch.float32:
        return f"runs on a CPU in float32, not on {device} in {dtype}"
    if rules.road.ring_m is not None:
        return "has no ring"
    if (traffic.idm, traffic.steering) != (rules.idm, rules.steering):
        return "has one set of parameters of car following and steering for the ego and the others"
    return None
