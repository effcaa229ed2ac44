"""HighwayEnv as a TorchRL environment.

Specs, reset, and step, by the tensor code or by the native kernel.
"""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import lru_cache
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv

from ganlane import keys
from ganlane.arguments import seed_number, whole_number
from ganlane.env.physics import (
    Recorder,
    Rules,
    begin,
    known_false,
    outcome,
    remember,
    run_decision,
)
from ganlane.env.state import (
    check_counter,
    checked_action,
    first_state,
    pack,
    spec_of,
    usable_device,
)
from ganlane.errors import UserError
from ganlane.native.drivers import Drivers, RuleDrivers, parts_of, pays
from ganlane.native.library import torch_on_one_thread, why_not
from ganlane.native.tensors import Kernel, NativeScenes, wants_gradient
from ganlane.settings.actions import CONTINUOUS, CONTROLS, LANE_SPEED, ActionParameters
from ganlane.settings.driving import EgoParameters, IdmParameters, MobilParameters, Visibility
from ganlane.settings.episode import KERNELS, EpisodeParameters, SpawnParameters
from ganlane.sim.dynamics import STEERING, SteeringParameters
from ganlane.sim.flow import let_in_and_out
from ganlane.sim.idm import TABLE_V
from ganlane.sim.mobil import TABLE_IV
from ganlane.sim.random import Purpose, episode_key, uniform
from ganlane.sim.scenes import Scenes
from ganlane.sim.spawn import RandomScenes, out_of_range, recycle
from ganlane.sim.state import Road, Vehicles, road_fields, road_in
from ganlane.traffic.base import TrafficModule

#: An automatic reset draws the scenes of the ended rows alone where they are at most one in so
#: many.
FEW_ROWS = 4


class HighwayEnv(EnvBase):
    """N highways with one ego each.

    Args:
        traffic: moves the other vehicles; its road is the environment's.
        num_envs: N, the batch size.
        vehicles: M, the ego included; None: as many as ``scenes`` has, 9 without.
        spawn_parameters: random initial scenes, Table II.
        ego: the ego's lane changes, visibility and soft crashes.
        episode: decision period, goal and time-out.
        idm: the ego's car following, Table V.
        steering: of the ego.
        seed: base of the random numbers; ``set_seed`` changes it for the next full reset.
        first_episode: row i starts with episode ``first_episode + i`` and continues in steps of N.
        scenes: initial vehicles of an episode and their visibility; None: at random, by
            ``spawn_parameters``.
        device, dtype: of the simulation's tensors.
        recycle: after every decision move vehicles far behind the ego to far ahead of it, and the
            reverse (:mod:`ganlane.sim.spawn`), so that the road never empties.
        recycle_share: share of the episodes in which ``recycle`` applies, 0 to 1, chosen by their
            numbers: a mixture of roads that empty and roads that do not.
        actions: what the driver of the ego commands.
        mobil: how the ego falls behind before a lane change that it has to make.
        kernel: what drives a decision: ``torch``, the tensor code; ``native``, the kernel
            (:mod:`ganlane.native`), which does the same up to rounding, for all shipped traffic
            but recordings, on a CPU and without gradients; ``auto``, the kernel where it can.

    An episode is (the traffic's stream, seed, episode), whatever the batch.

    ``reset(td)`` with ``seed`` and ``episode`` [N] in ``td`` and no ``_reset`` mask runs exactly
    those episodes. With a mask the masked rows continue with their episode plus N, or
    ``next_episode`` [N] of ``reset(td, next_episode=...)``, on the seed in ``td``.

    :attr:`recorder`, if set, is called after every physics step.

    Raises:
        UserError: the vehicles do not fit on the road or could not brake in time, the decision
            period is not a multiple of 0.1 s, ``recycle_share`` is no share, or the native kernel
            cannot do what is asked.
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
        seed: int = 0,
        first_episode: int = 0,
        device: torch.device | str | None = None,
        dtype: torch.dtype = torch.float32,
        scenes: Scenes | None = None,
        recycle: bool = False,
        recycle_share: float = 1.0,
        kernel: str = "torch",
        actions: ActionParameters | None = None,
        mobil: MobilParameters = TABLE_IV,
    ) -> None:
        # Those who call this from Python meet no record that would check types.
        if not isinstance(traffic, TrafficModule):
            raise UserError(
                f"traffic={traffic!r:.80}: expected a TrafficModule; give one, or a name to "
                "ganlane.make_env()."
            )
        if scenes is not None and not callable(scenes):
            raise UserError(f"scenes={scenes!r:.80}: expected scenes; give a FixedScene, say.")

        # The bounds of the settings lie within.
        whole_number("num_envs", num_envs, 1, 2**20)
        whole_number("first_episode", first_episode, 0, 2**62)
        if vehicles is not None:
            whole_number("vehicles", vehicles, 1, 1000)

        # Checked before EnvBase allocates anything on it.
        device = usable_device(device, dtype)
        super().__init__(device=device, batch_size=torch.Size([int(num_envs)]))
        self._seed = seed_number(seed)
        self.first_episode = first_episode
        self.dtype = dtype

        # Who drives, and where.
        self.traffic = traffic.to(self.device)
        self.road: Road = traffic.road
        self.stream = traffic.stream

        # Settings; what is left out is as its record has it.
        self.spawn_parameters = spawn_parameters or SpawnParameters()
        self.ego = ego or EgoParameters()
        self.episode = episode or EpisodeParameters()
        self.actions = actions or ActionParameters()
        self.recycle = recycle
        self.recycle_share = recycle_share

        # The traffic may have scenes of its own, with their number of vehicles.
        self.scenes = scenes or self._default_scenes(vehicles or 9)
        self.vehicles = self.scenes.vehicles

        # Constants of every episode, handed to the pure functions of physics.
        self.rules = Rules(
            self.road,
            self.ego,
            self.episode,
            idm,
            steering,
            self.actions,
            mobil,
        )

        self._check_parts(vehicles)

        #: Called after every physics step; None: nobody looks.
        self.recorder: Recorder | None = None
        #: Seed and episode [N] of the rows in the last call; automatic resets continue from there.
        self.last_episodes: tuple[Tensor, Tensor] | None = None

        #: The native kernel; None: the tensor code drives.
        self.kernel = self._make_kernel(kernel)
        self._must_be_native = kernel == "native"

        #: Draws the scenes of Table II by the kernel too; None: the tensor code draws them.
        self._native_scenes: NativeScenes | None = None
        if self.kernel is not None and type(self.scenes) is RandomScenes:
            self._native_scenes = NativeScenes(
                self.scenes,
                self.stream,
                self.traffic.native_drivers(),
                self.actions,
            )

        self._make_specs()

    def _default_scenes(self, vehicles: int) -> Scenes:
        """The traffic's own scenes if it has any, else random ones of so many ``vehicles``."""
        spawn = self.spawn_parameters
        visibility = Visibility.named(self.ego.visibility)
        scenes = self.traffic.scenes(vehicles, visibility, spawn.ego_desired_speed_mps)
        if scenes is not None:
            return scenes
        return RandomScenes(
            self.road,
            vehicles,
            spawn,
            visibility,
            self.traffic.visibility,
        )

    def _check_parts(self, vehicles: int | None) -> None:
        """Check that traffic, road, actions, recycling and scenes fit together.

        Args:
            vehicles: M as the user asked for it; None: as many as the scenes have.

        Raises:
            UserError: they do not.
        """
        if self.road.stretches and not self.traffic.heeds_lane_ends:
            raise UserError(
                f"{type(self.traffic).__name__} does not heed the ends of lanes; take another "
                "traffic (idm_mobil, gan_calibrated, ...), or a road whose lanes go on."
            )
        if self.actions.form == CONTINUOUS and self.traffic.rows_must_stay:
            raise UserError(
                f"env.actions={CONTINUOUS} with a foreign simulator, which moves its copy of the "
                "ego by car following; take another traffic, or env.actions=lane."
            )

        if self.recycle and self.road.stretches:
            raise UserError(
                "env.recycle=true on a road with lanes that end: vehicles would return where their "
                "lane is not; leave it off."
            )
        if self.recycle and self.traffic.own_roads:
            raise UserError(
                "env.recycle=true with replayed traffic: recorded vehicles go where they went; "
                "leave it off."
            )
        if not 0.0 <= self.recycle_share <= 1.0:
            raise UserError(
                f"env.recycle_share={self.recycle_share:g}: expected a number from 0 to 1; "
                "give such a share."
            )

        if vehicles is not None and vehicles != self.vehicles:
            raise UserError(
                f"vehicles={vehicles}: the scene has {self.vehicles}, the ego included; "
                "leave this number out."
            )
        self.scenes.check(self.road, self.rules.idm)

    def _make_specs(self) -> None:
        """TorchRL's specs of observation, state, action, reward and done flags."""
        n = self.batch_size[0]
        device = self.device

        # Of any episode: the fields and shapes are those of all, the traffic's memory included.
        episode = torch.zeros(n, dtype=torch.int64, device=device)
        state = self._start(episode, episode)
        self.observation_spec = spec_of(state.exclude(*keys.DONE_FLAGS)).to(device)

        # A TransformedEnv passes to a reset only the keys of the state spec; without the counters a
        # reset to certain episodes would run the first ones.
        counters = {
            keys.SEED: self.observation_spec[keys.SEED].clone(),
            keys.EPISODE: self.observation_spec[keys.EPISODE].clone(),
        }
        self.state_spec = Composite(counters, shape=(n,), device=device)

        if self.actions.form == CONTINUOUS:
            shape = (n, CONTROLS)
            self.action_spec = Bounded(-1.0, 1.0, shape=shape, dtype=self.dtype, device=device)
        else:
            count = len(self.actions.names)
            self.action_spec = Categorical(count, shape=(n,), dtype=torch.int64, device=device)

        self.reward_spec = Unbounded(shape=(n, 1), dtype=self.dtype, device=device)
        self.done_spec = spec_of(state.select(*keys.DONE_FLAGS)).to(device)

    def to(self, device: torch.device | str) -> HighwayEnv:
        """On another device; raises :class:`UserError` where there is none such."""
        return super().to(usable_device(device, self.dtype))

    def _set_seed(self, seed: int | None) -> None:
        self._seed = 0 if seed is None else seed_number(seed)

    def _episodes(
        self,
        tensordict: TensorDictBase | None,
        mask: Tensor | None,
        next_episode: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Seed and episode of every row after this reset, each [N] int64.

        Args:
            tensordict: what TorchRL hands in: nothing, a mask, counters, or counters and a mask.
            mask: the rows to reset, [N] bool; None: all.
            next_episode: of the rows of ``mask``, [N] int64; None: the row's episode plus N.

        Raises:
            UserError: counters of another shape or type.
        """
        n = self.batch_size[0]
        if tensordict is not None and keys.EPISODE in tensordict:
            seed = check_counter(keys.SEED, tensordict.get(keys.SEED, None), n)
            last = check_counter(keys.EPISODE, tensordict.get(keys.EPISODE), n)
        elif mask is not None and self.last_episodes is not None:
            # In an automatic reset TorchRL passes the mask without the counters.
            seed, last = self.last_episodes
        else:
            # A full reset: back to the first episodes.
            seed = torch.full((n,), self._seed, dtype=torch.int64, device=self.device)
            return seed, self.first_episode + torch.arange(n, device=self.device)

        # Without a mask the counters name the episodes; with one they are those that have ended.
        if mask is None:
            return seed, last

        # Row i of N drives the episodes i, i + N, i + 2N, ... unless the caller knows better.
        following = last + n
        if next_episode is not None:
            following = check_counter("next_episode", next_episode, n)
        return seed, torch.where(mask, following, last)

    def _reset(
        self,
        tensordict: TensorDictBase | None,
        next_episode: Tensor | None = None,
        **kwargs: object,
    ) -> TensorDictBase:
        """All rows at the start of their episodes; EnvBase keeps the rows that go on.

        Args:
            tensordict: may hold the mask ``_reset`` and the counters ``seed`` and ``episode``.
            next_episode: as of :meth:`_episodes`.
            kwargs: TorchRL's; nothing here needs them.
        """
        mask = None
        if tensordict is not None:
            mask = tensordict.get("_reset", None)
        if mask is not None:
            # TorchRL's has the shape of the done flags, [N, 1].
            mask = mask.reshape(-1)
        seed, episode = self._episodes(tensordict, mask, next_episode)
        self.last_episodes = (seed, episode)

        if self._native_scenes is not None:
            # The kernel draws the masked rows alone.
            return self._native_scenes.start(seed, episode, mask)

        # On a GPU counting the masked rows would wait for its queue; a foreign simulator knows its
        # rows by their place.
        if mask is None or self.device.type != "cpu" or self.traffic.rows_must_stay:
            return self._start(seed, episode)

        # Few rows: their scenes alone are drawn.
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
        """The first states of the episodes (``seed``, ``episode``), each [K] int64."""
        # Scene, drivers and road of an episode all follow from its key.
        key = episode_key(self.stream, seed, episode)
        vehicles = self.scenes(key, self.dtype).with_finite_padding()
        vehicles, memory = self.traffic.enter(vehicles, key, episode)
        state = first_state(seed, episode, vehicles, memory, self.actions)

        # Recorded scenes each have a road of their own.
        if self.traffic.own_roads:
            road = self.traffic.road_of(key, self.dtype)
            state.set(keys.ROAD, TensorDict(road_fields(road), seed.shape))
        return state

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """One decision.

        Raises:
            UserError: ``tensordict`` holds no state, or an action that does not exist.
        """
        seed = tensordict.get(keys.SEED, None)
        episode = tensordict.get(keys.EPISODE, None)
        if seed is None or episode is None:
            raise UserError(
                "step(): the state of no episode was given; call reset() first and step what it "
                "returns."
            )
        # An automatic reset goes on from these.
        self.last_episodes = (seed, episode)

        step = self._tensor_step if self.kernel is None else self._native_step
        after = step(tensordict)

        # A transform writes the reward.
        reward = torch.zeros_like(after.get(keys.EGO).get("distance"))[:, None]
        return after.set(keys.REWARD, reward)

    def _tensor_step(self, state: TensorDictBase) -> TensorDictBase:
        """One decision by the tensor code."""
        action = checked_action(state.get(keys.ACTION, None), self.batch_size[0], self.actions)
        key = episode_key(self.stream, state.get(keys.SEED), state.get(keys.EPISODE))
        rules = self.rules
        if self.traffic.own_roads:
            # Replayed scenes have their own roads and ends.
            road = road_in(state, self.road)
            steps = self.traffic.steps_of(key)
            rules = rules._replace(road=road, scene_steps=steps)
        vehicles = Vehicles.of(state.get(keys.VEHICLES))
        ego = dict(state.get(keys.EGO).items())

        # The command, then traffic and ego step by step, then what the ego remembers of it.
        start, command = begin(rules, action, vehicles, ego, state.get(keys.STEP))
        end, memory = run_decision(self.traffic, rules, state, start, key, self.recorder)
        ego = remember(rules, ego, start, end, command)

        # Done flags, counters and road are beside those groups of fields.
        events, rest = outcome(end)
        rest[keys.SEED] = state.get(keys.SEED)
        rest[keys.EPISODE] = state.get(keys.EPISODE)
        rest[keys.STEP] = end.step
        if self.traffic.own_roads:
            rest[keys.ROAD] = state.get(keys.ROAD)

        # What happens between decisions: vehicles return, enter or leave.
        vehicles = end.vehicles
        if self.actions.form == LANE_SPEED:
            # The desired speed itself is the same in all of an episode.
            desired_speed = state.get(keys.VEHICLES).get("desired_speed")
            vehicles = vehicles.with_(desired_speed=desired_speed)
        # Mostly nobody is out of range: without this look a decision takes 2 % longer with 64 rows,
        # 9 % with 1024.
        if self.recycle and not known_false(out_of_range(vehicles, rules.road).any()):
            # In running rows with recycling those left behind are moved.
            recycled = recycle(vehicles, rules.road, rules.idm)
            rows = end.running & self._recycling_rows(key)
            vehicles = recycled.where(rows, vehicles)
        if rules.road.flow is not None:
            flowed = let_in_and_out(
                vehicles,
                rules.road,
                rules.idm,
                key,
                step=end.step,
                period_s=self.episode.decision_period_s,
            )
            vehicles = flowed.where(end.running, vehicles)
        return pack(vehicles, ego, memory, events, rest)

    def _native_step(self, state: TensorDictBase) -> TensorDictBase:
        """One decision by the kernel; where a gradient is due, with ``auto`` by the tensor code.

        Raises:
            UserError: a gradient is due with ``native``, or the action does not exist.
        """
        assert self.kernel is not None
        fields = [*state.get(keys.VEHICLES).values(), *state.get(keys.EGO).values()]
        if wants_gradient(fields):
            if self._must_be_native:
                raise UserError(
                    "env.kernel=native has no gradients, and the state requires one; set "
                    "env.kernel=torch, or step under torch.no_grad()."
                )
            return self._tensor_step(state)

        rows = self.batch_size[0]
        action = checked_action(state.get(keys.ACTION, None), rows, self.actions, values=False)
        if not self._must_be_native:
            say_once("env.kernel=auto: the native kernel")

        # In which rows vehicles return after the decision, or enter and leave, [N] bool.
        recycles = None
        if self.road.flow is not None:
            # In every row.
            recycles = torch.ones_like(state.get(keys.EPISODE), dtype=torch.bool)
        if self.recycle:
            key = episode_key(self.stream, state.get(keys.SEED), state.get(keys.EPISODE))
            recycles = self._recycling_rows(key)

        # The kernel looks at the actions' values itself: that costs nothing there.
        try:
            after = self.kernel.decide(action, state, recycles)
        except ValueError:
            # Says which action is wrong.
            checked_action(action, rows, self.actions)
            raise
        if self.recorder is not None:
            self._show_steps(self.recorder, state, action)
        return after

    def _show_steps(self, recorder: Recorder, state: TensorDictBase, action: Tensor) -> None:
        """Show ``recorder`` the physics steps of the decision ``action`` [N] in ``state``.

        The kernel drives it once more, in decisions of one physics step, which gives the same bits.
        """
        if self.actions.form == CONTINUOUS:
            # Its line is one of the decision, so it cannot be given step by step.
            self._tensor_step(state)
            return

        # A kernel whose decision is one physics step.
        drivers = self.traffic.native_drivers()
        assert drivers is not None
        episode = replace(self.episode, decision_period_s=keys.PHYSICS_STEP_S)
        # Steps of 0.1 s instead of a decision period, after which nobody enters or leaves; nothing
        # else differs.
        kernel = self._kernel(drivers, episode)

        vehicles = Vehicles.of(state.get(keys.VEHICLES))
        running = torch.ones_like(action, dtype=torch.bool)
        for _ in range(self.episode.substeps()):
            state = kernel.decide(action, state, None)

            # A command off the road ends an episode before anything moves.
            running = running & ~state.get(keys.EVENTS).get("out_of_road")[:, 0]
            if not running.any():
                break

            # Ended rows stand still for the recorder; the kernel would drive them on.
            vehicles = Vehicles.of(state.get(keys.VEHICLES)).where(running, vehicles)
            recorder(vehicles, running)
            running = running & ~state.get("done")[:, 0]

            # The command is given once; during a lane change keeping the lane continues it.
            action = torch.full_like(action, keys.KEEP)

    def _others_change_otherwise(self, drivers: Drivers) -> bool:
        """Whether some of the others change lanes by MOBIL with other parameters than the ego."""
        for part in parts_of(drivers):
            if not isinstance(part.drivers, RuleDrivers):
                continue
            # None: they do not change lanes by MOBIL.
            if part.drivers.mobil not in (None, self.rules.mobil):
                return True
        return False

    def _make_kernel(self, wanted: str) -> Kernel | None:
        """The kernel for ``wanted`` (``torch``, ``native`` or ``auto``); None: the tensor code.

        Raises:
            UserError: an unknown name, or ``native`` where the kernel cannot do what is asked or
                cannot be built.
        """
        if wanted not in KERNELS:
            raise UserError(
                f"env.kernel={wanted}: expected one of {', '.join(KERNELS)}; choose one of them."
            )
        if wanted == "torch":
            return None

        # What the kernel cannot do.
        drivers = self.traffic.native_drivers()
        reason = self._lacks(drivers, wanted)
        # And whether there is a library at all, which may have to be built.
        missing = why_not() if reason is None else None
        if drivers is not None and reason is None and missing is None:
            return self._kernel(drivers, self.episode)

        # Whoever asks for the kernel gets it or an error; auto says once what is missing.
        if wanted == "native":
            raise UserError(f"env.kernel=native {reason or missing}; set env.kernel=torch.")
        if reason is None:
            say_once(f"env.kernel=auto: the tensor code, since the native kernel {missing}.")
        return None

    def _lacks(self, drivers: Drivers | None, wanted: str) -> str | None:
        """Why the kernel cannot drive, as the end of a sentence; None: it can."""
        if drivers is None:
            return f"does not drive {type(self.traffic).__name__}"
        if wanted == "auto" and not pays(drivers):
            return "is slow with generated traffic on a processor without FMA"
        if self.device.type != "cpu" or self.dtype != torch.float32:
            return f"runs on a CPU in float32, not on {self.device} in {self.dtype}"
        if self.road.ring_m is not None:
            return "has no ring"

        # It has the same parameters for all vehicles.
        if (drivers.idm, drivers.steering) != (self.rules.idm, self.rules.steering):
            return (
                "has one set of parameters of car following and steering for the ego and the others"
            )
        # The ego changes lanes by itself only where they end.
        if self.road.stretches and self._others_change_otherwise(drivers):
            return "has one set of parameters of lane changes for the ego and the others"
        return None

    def _kernel(self, drivers: Drivers, episode: EpisodeParameters) -> Kernel:
        """A kernel of this environment for decisions as of ``episode``."""
        return Kernel(
            self.road,
            self.vehicles,
            episode,
            self.ego,
            drivers,
            actions=self.actions,
            mobil=self.rules.mobil,
        )

    def _recycling_rows(self, key: Tensor) -> Tensor:
        """The rows [N] bool whose episodes, with ``key`` [N], recycle."""
        if self.recycle_share >= 1.0:
            return torch.ones_like(key, dtype=torch.bool)

        # Step -1, before the first, so that no other number is the same draw.
        drawn = uniform(key, -1, 1, [Purpose.RECYCLED_EPISODE], torch.float64)
        return drawn[..., 0].reshape(key.shape) < self.recycle_share


class TransformedHighway(TransformedEnv):
    """A :class:`HighwayEnv` behind transforms.

    Where the kernel drives, torch computes on one thread during a step or reset, and the kernel on
    as many as torch had (:func:`~ganlane.native.library.torch_on_one_thread`).
    """

    def _threads(self) -> AbstractContextManager[None]:
        if self.base_env.kernel is None:
            return nullcontext()
        return torch_on_one_thread()

    def reset(self, *arguments: Any, **options: Any) -> TensorDictBase:
        """As of every environment."""
        with self._threads():
            return super().reset(*arguments, **options)

    def step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """As of every environment."""
        with self._threads():
            return super().step(tensordict)


@lru_cache(maxsize=8)
def say_once(line: str) -> None:
    """Print a line to the standard error stream, the first time that it is given."""
    print(line, file=sys.stderr)
