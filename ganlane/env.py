"""HighwayEnv: the simulator as a batched, stateless TorchRL environment. Raw state in, raw state and events out.

    action -> ego driver (target lane) -> [ traffic module -> ego dynamics -> events ] x substeps -> done flags

Observation and reward are transforms (:mod:`ganlane.transforms`); without them the environment shows its raw
state and pays nothing. The state travels in the TensorDict, so it can be copied, saved and branched.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.data.tensor_specs import Binary
from torchrl.envs import EnvBase

from ganlane import keys
from ganlane.errors import UserError
from ganlane.keys import EGO_INDEX, PHYSICS_STEP_S
from ganlane.sim.collisions import ego_overlaps
from ganlane.sim.ego import (
    Command,
    EgoParameters,
    change_progress,
    ego_scene,
    move_ego,
    obey,
    soft_crash_ahead,
    soft_crash_behind,
)
from ganlane.sim.idm import TABLE_V, IdmParameters
from ganlane.sim.lanes import settled
from ganlane.sim.neighbours import Scene
from ganlane.sim.random import Stream, absorb, episode_key
from ganlane.sim.road import Road
from ganlane.sim.spawn import SpawnParameters, spawn
from ganlane.sim.steering import STEERING, SteeringParameters
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import TrafficModule

#: Called after every physics step with the vehicles and the rows that are still running.
Recorder = Callable[[Vehicles, Tensor], None]

_EGO_FLOATS = ("steering", "mean_acceleration", "change_progress", "distance")
_EGO_INTEGERS = ("change_direction", "decisions", "lane_changes")
_EGO_FLAGS = ("soft_crash", "soft_crash_behind", "started_change")


@dataclass(frozen=True)
class EpisodeParameters:
    """When the ego decides and when an episode ends; s and m."""

    decision_period_s: float = 1.0
    goal_m: float = 5000.0
    timeout_s: float = 1000.0

    def substeps(self) -> int:
        """Physics steps per decision."""
        return round(self.decision_period_s / PHYSICS_STEP_S)

    def check(self) -> None:
        """Raise :class:`UserError` where the decision period is not a whole number of physics steps."""
        if self.substeps() < 1 or abs(self.substeps() * PHYSICS_STEP_S - self.decision_period_s) > 1e-9:
            raise UserError(
                f"env.decision_period_s={self.decision_period_s:g} is not a multiple of {PHYSICS_STEP_S:g} s; "
                "choose 0.1, 0.2, ... 1.0 or more."
            )


class _Substep(NamedTuple):
    """What is carried from one physics step to the next within a decision."""

    vehicles: Vehicles
    traffic: TensorDictBase
    scene: Scene
    steering: Tensor
    ahead: Tensor
    behind: Tensor
    step: Tensor
    running: Tensor
    onsets: Tensor
    onsets_behind: Tensor
    hard_crash: Tensor
    goal: Tensor


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
        stream: family of episodes (training, selection, report).
        seed: base of the random numbers; ``set_seed`` changes it for the next full reset.
        first_episode: row i starts with episode ``first_episode + i`` and goes on in steps of N.
        device, dtype: where and in which float type to simulate.

    An episode is (stream, seed, episode) and does not depend on the batch. ``reset(td)`` with ``seed`` and
    ``episode`` [N] in ``td`` and no ``_reset`` mask runs exactly those episodes.

    Raises:
        UserError: the vehicles do not fit on the road, or the decision period is not a multiple of 0.1 s.
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
        stream: int = Stream.TRAIN,
        seed: int = 0,
        first_episode: int = 0,
        device: torch.device | str | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__(device=device or torch.device("cpu"), batch_size=torch.Size([num_envs]))
        self.traffic = traffic.to(self.device)
        self.road: Road = traffic.road
        self.spawn_parameters = spawn_parameters or SpawnParameters()
        self.ego = ego or EgoParameters()
        self.episode = episode or EpisodeParameters()
        self.idm, self.steering = idm, steering
        self.vehicles, self.stream, self.dtype = vehicles, int(stream), dtype
        self.first_episode = first_episode
        self.recorder: Recorder | None = None
        self._seed = seed
        self.episode.check()
        if isinstance(self.road.lanes, int):
            self.spawn_parameters.check(vehicles, self.road.lanes)
        self._make_specs()

    # Specs

    def _make_specs(self) -> None:
        n, m, dtype = self.batch_size[0], self.vehicles, self.dtype
        floats = {name: _unbounded((n, m), dtype) for name in keys.VEHICLE_FLOATS}
        integers = {name: _unbounded((n, m), torch.int64) for name in keys.VEHICLE_INTEGERS}
        flags = {name: _flag((n, m)) for name in keys.VEHICLE_FLAGS}
        ego = {name: _unbounded((n,), dtype) for name in _EGO_FLOATS}
        ego |= {name: _unbounded((n,), torch.int64) for name in _EGO_INTEGERS}
        ego |= {name: _flag((n,)) for name in _EGO_FLAGS}
        events = {name: _flag((n, 1)) for name in keys.END_EVENTS}
        events |= {name: _unbounded((n, 1), torch.int64) for name in (keys.SOFT_CRASH, keys.SOFT_CRASH_BEHIND)}
        counters = {name: _unbounded((n,), torch.int64) for name in (keys.SEED, keys.EPISODE, keys.STEP)}
        memory = self.traffic.memory_spec(n, m, dtype)
        self.observation_spec = Composite(
            {
                keys.VEHICLES: Composite({**floats, **integers, **flags}, shape=(n,)),
                keys.EGO: Composite(ego, shape=(n,)),
                keys.EVENTS: Composite(events, shape=(n,)),
                keys.TRAFFIC: _memory_composite(memory, n),
                **counters,
            },
            shape=(n,),
        ).to(self.device)
        self.action_spec = Categorical(3, shape=(n,), dtype=torch.int64, device=self.device)
        self.reward_spec = _unbounded((n, 1), dtype).to(self.device)
        self.done_spec = Composite(
            {name: _flag((n, 1)) for name in ("done", "terminated", "truncated")}, shape=(n,)
        ).to(self.device)

    def _set_seed(self, seed: int | None) -> None:
        self._seed = 0 if seed is None else int(seed)

    # Reset

    def _episodes(self, tensordict: TensorDictBase | None) -> tuple[Tensor, Tensor]:
        """Seed and episode [N] of every row after this reset."""
        n = self.batch_size[0]
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if tensordict is not None and keys.EPISODE in tensordict.keys():
            episode, seed = tensordict.get(keys.EPISODE), tensordict.get(keys.SEED)
            return seed, episode if mask is None else torch.where(mask.reshape(n), episode + n, episode)
        seed = torch.full((n,), self._seed, dtype=torch.int64, device=self.device)
        return seed, self.first_episode + torch.arange(n, device=self.device)

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: object) -> TensorDictBase:
        seed, episode = self._episodes(tensordict)
        key = episode_key(self.stream, seed, episode)
        vehicles = self._spawn(key)
        who = torch.ones_like(vehicles.valid)
        memory = self.traffic.init_memory(vehicles, who, absorb(key, 0))
        zero = torch.zeros(self.batch_size, dtype=self.dtype, device=self.device)
        ego = {name: zero for name in _EGO_FLOATS} | {name: zero.long() for name in _EGO_INTEGERS}
        ego |= {name: zero.bool() for name in _EGO_FLAGS}
        events = {name: zero[:, None].bool() for name in keys.END_EVENTS}
        events |= {name: zero[:, None].long() for name in (keys.SOFT_CRASH, keys.SOFT_CRASH_BEHIND)}
        flags = {name: zero[:, None].bool() for name in ("done", "terminated", "truncated")}
        counters = {keys.SEED: seed, keys.EPISODE: episode, keys.STEP: torch.zeros_like(seed)}
        return self._pack(vehicles, ego, memory, events, {**counters, **flags})

    def _spawn(self, key: Tensor) -> Vehicles:
        lanes, width = self.road.lanes, self.road.lane_width_m
        assert isinstance(lanes, int)
        assert isinstance(width, float)
        return spawn(
            key,
            self.vehicles,
            lanes,
            width,
            self.spawn_parameters,
            self.dtype,
            self.ego.visibility,
            self.traffic.visibility,
        )

    def _pack(
        self, vehicles: Vehicles, ego: dict, traffic: TensorDictBase, events: dict, rest: dict
    ) -> TensorDictBase:
        batch, device = self.batch_size, self.device
        nested = {keys.VEHICLES: vehicles.as_dict(), keys.EGO: ego, keys.EVENTS: events}
        made = {
            name: TensorDict._new_unsafe(value, batch_size=batch, device=device) for name, value in nested.items()
        }
        return TensorDict._new_unsafe({**made, keys.TRAFFIC: traffic, **rest}, batch_size=batch, device=device)

    # Step

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        vehicles = Vehicles.of(tensordict.get(keys.VEHICLES))
        memory = tensordict.get(keys.EGO)
        command = self._command(tensordict.get(keys.ACTION), vehicles, memory)
        start_speed = vehicles.speed[:, EGO_INDEX]
        at = self._begin(tensordict, vehicles, memory, command)
        for _ in range(self.episode.substeps()):
            # Rows that ended stay as they are. On a CPU it costs nothing to ask whether there are any.
            if at.running.device.type == "cpu" and not bool(at.running.any()):
                break
            at = self._substep(tensordict, at)
        return self._finish(tensordict, at, command, memory, start_speed)

    def _command(self, action: Tensor, vehicles: Vehicles, memory: TensorDictBase) -> Command:
        lanes = self.road.lanes if isinstance(self.road.lanes, int) else self.road.lanes[:, 0]
        target = vehicles.target_lane[:, EGO_INDEX]
        return obey(action, target, memory.get("change_direction"), lanes, self.ego.abort_lane_change)

    def _begin(
        self, tensordict: TensorDictBase, vehicles: Vehicles, memory: TensorDictBase, command: Command
    ) -> _Substep:
        target = torch.cat((command.target_lane[:, None], vehicles.target_lane[:, 1:]), dim=1)
        vehicles = vehicles.with_(target_lane=target)
        none = torch.zeros_like(command.off_road)
        return _Substep(
            vehicles=vehicles,
            traffic=tensordict.get(keys.TRAFFIC),
            scene=ego_scene(vehicles, self.road),
            steering=memory.get("steering"),
            ahead=memory.get("soft_crash"),
            behind=memory.get("soft_crash_behind"),
            step=tensordict.get(keys.STEP),
            running=~command.off_road,
            onsets=none.long(),
            onsets_behind=none.long(),
            hard_crash=none,
            goal=none,
        )

    def _move_traffic(self, tensordict: TensorDictBase, at: _Substep) -> tuple[Vehicles, TensorDictBase]:
        view = TensorDict._new_unsafe(
            {
                keys.VEHICLES: TensorDict._new_unsafe(at.vehicles.as_dict(), batch_size=self.batch_size),
                keys.TRAFFIC: at.traffic,
                keys.SEED: tensordict.get(keys.SEED),
                keys.EPISODE: tensordict.get(keys.EPISODE),
                keys.STEP: at.step,
            },
            batch_size=self.batch_size,
        )
        self.traffic(view)
        return Vehicles.of(view.get(keys.MOVED)), view.get(keys.TRAFFIC)

    def _substep(self, tensordict: TensorDictBase, at: _Substep) -> _Substep:
        """One physics step; rows that are not running keep everything as it is."""
        moved, traffic = self._move_traffic(tensordict, at)
        ego, steering = move_ego(at.scene, at.steering, self.road, self.idm, self.steering, PHYSICS_STEP_S)
        moved = moved.with_first(ego)
        everybody = at.running.device.type == "cpu" and bool(at.running.all())
        if not everybody:
            moved = moved.where(at.running, at.vehicles)
            traffic = _where(at.running, traffic, at.traffic)
            steering = torch.where(at.running, steering, at.steering)
        scene = ego_scene(moved, self.road)
        ahead, behind = soft_crash_ahead(scene, self.ego), soft_crash_behind(scene, self.ego)
        crash = ego_overlaps(moved).any(-1) & at.running
        goal = (moved.x[:, EGO_INDEX] >= self.episode.goal_m) & at.running & ~crash
        step = at.step + at.running
        late = step >= round(self.episode.timeout_s / PHYSICS_STEP_S)
        if self.recorder is not None:
            self.recorder(moved, at.running)
        return _Substep(
            vehicles=moved,
            traffic=traffic,
            scene=scene,
            steering=steering,
            ahead=torch.where(at.running, ahead, at.ahead),
            behind=torch.where(at.running, behind, at.behind),
            step=step,
            running=at.running & ~(crash | goal | late),
            onsets=at.onsets + (ahead & ~at.ahead & at.running),
            onsets_behind=at.onsets_behind + (behind & ~at.behind & at.running),
            hard_crash=at.hard_crash | crash,
            goal=at.goal | goal,
        )

    def _finish(
        self, tensordict: TensorDictBase, at: _Substep, command: Command, memory: TensorDictBase, start_speed: Tensor
    ) -> TensorDictBase:
        ego = at.vehicles.at(EGO_INDEX)
        arrived = settled(at.vehicles.columns(slice(0, 1)), self.road)[:, 0]
        direction = torch.where(arrived, 0, command.direction)
        steps = (at.step - tensordict.get(keys.STEP)).clamp_min(1)
        terminated = at.goal | at.hard_crash | command.off_road
        timeout = ~at.running & ~terminated
        remembered = {
            "steering": at.steering,
            "mean_acceleration": (ego.speed - start_speed) / (steps.to(self.dtype) * PHYSICS_STEP_S),
            "change_progress": change_progress(ego, direction, self.road),
            "distance": ego.x,
            "change_direction": direction,
            "decisions": memory.get("decisions") + 1,
            "lane_changes": memory.get("lane_changes") + command.starts,
            "soft_crash": at.ahead,
            "soft_crash_behind": at.behind,
            "started_change": command.starts,
        }
        events = {
            "goal": at.goal,
            "hard_crash": at.hard_crash,
            "out_of_road": command.off_road,
            "timeout": timeout,
            "scene_end": torch.zeros_like(timeout),
            keys.SOFT_CRASH: at.onsets,
            keys.SOFT_CRASH_BEHIND: at.onsets_behind,
        }
        rest = {
            keys.SEED: tensordict.get(keys.SEED),
            keys.EPISODE: tensordict.get(keys.EPISODE),
            keys.STEP: at.step,
            "terminated": terminated[:, None],
            "truncated": timeout[:, None],
            "done": (terminated | timeout)[:, None],
            keys.REWARD: torch.zeros_like(ego.speed)[:, None],
        }
        return self._pack(at.vehicles, remembered, at.traffic, {k: v[:, None] for k, v in events.items()}, rest)


def _unbounded(shape: tuple[int, ...], dtype: torch.dtype) -> Unbounded:
    return Unbounded(shape=shape, dtype=dtype)


def _flag(shape: tuple[int, ...]) -> Binary:
    return Binary(shape=shape, dtype=torch.bool)


def _memory_composite(memory: dict, n: int) -> Composite:
    """Composite spec of a traffic module's memory, nested like the modules."""
    specs = {
        name: _memory_composite(value, n) if isinstance(value, dict) else _unbounded(*value)
        for name, value in memory.items()
    }
    return Composite(specs, shape=(n,))


def _where(rows: Tensor, new: TensorDictBase, old: TensorDictBase) -> TensorDictBase:
    """``new`` in the rows [N] that are running, ``old`` in the others, leaf by leaf."""

    def choose(fresh: Tensor, kept: Tensor) -> Tensor:
        return torch.where(rows.reshape(-1, *[1] * (fresh.ndim - 1)), fresh, kept)

    return new.apply(choose, old)
