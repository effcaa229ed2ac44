"""One decision of the ego, driven through its physics steps. Rows that end stay as they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.env.state import where
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
from ganlane.sim.idm import IdmParameters
from ganlane.sim.lanes import settled
from ganlane.sim.neighbours import Scene
from ganlane.sim.road import Road
from ganlane.sim.steering import SteeringParameters
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import TrafficModule, memory_of

#: Called after every physics step with the vehicles and the rows [N] that were running in it.
Recorder = Callable[[Vehicles, Tensor], None]


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


class World(NamedTuple):
    """What stays the same in an episode: the road, who drives on it, and by which parameters."""

    road: Road
    traffic: TrafficModule
    ego: EgoParameters
    episode: EpisodeParameters
    idm: IdmParameters
    steering: SteeringParameters


class Substep(NamedTuple):
    """What is carried from one physics step to the next within a decision; fields [N] but for the first three.

    ``ahead`` and ``behind`` say whether the ego is dangerously close, ``onsets`` count how often that began.
    """

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


def command(world: World, action: Tensor, vehicles: Vehicles, ego: TensorDictBase) -> Command:
    """What ``action`` [N] leads to."""
    lanes = world.road.lanes if isinstance(world.road.lanes, int) else world.road.lanes[:, 0]
    target, direction = vehicles.target_lane[:, EGO_INDEX], ego.get("change_direction")
    return obey(action, target, direction, lanes, world.ego.abort_lane_change)


def begin(world: World, state: TensorDictBase, ordered: Command) -> Substep:
    """The decision's first moment: the command is given, nothing has moved. Who leaves the road is not running."""
    vehicles, ego = Vehicles.of(state.get(keys.VEHICLES)), state.get(keys.EGO)
    target = torch.cat((ordered.target_lane[:, None], vehicles.target_lane[:, 1:]), dim=1)
    vehicles = vehicles.with_(target_lane=target)
    none = torch.zeros_like(ordered.off_road)
    return Substep(
        vehicles=vehicles,
        traffic=memory_of(state),
        scene=ego_scene(vehicles, world.road),
        steering=ego.get("steering"),
        ahead=ego.get("soft_crash"),
        behind=ego.get("soft_crash_behind"),
        step=state.get(keys.STEP),
        running=~ordered.off_road,
        onsets=none.long(),
        onsets_behind=none.long(),
        hard_crash=none,
        goal=none,
    )


def move_traffic(world: World, state: TensorDictBase, at: Substep) -> tuple[Vehicles, TensorDictBase]:
    """The others at t + 0.1 s (index 0 is meaningless) and the traffic's memory."""
    batch = state.batch_size
    view = TensorDict._new_unsafe(
        {
            keys.VEHICLES: TensorDict._new_unsafe(at.vehicles.as_dict(), batch_size=batch),
            keys.TRAFFIC: at.traffic,
            keys.SEED: state.get(keys.SEED),
            keys.EPISODE: state.get(keys.EPISODE),
            keys.STEP: at.step,
        },
        batch_size=batch,
    )
    world.traffic(view)
    return Vehicles.of(view.get(keys.MOVED)), view.get(keys.TRAFFIC)


def move(world: World, state: TensorDictBase, at: Substep) -> tuple[Vehicles, TensorDictBase, Tensor]:
    """Everybody, the traffic's memory and the ego's steering at t + 0.1 s; all of them reacted to the state at t."""
    moved, traffic = move_traffic(world, state, at)
    ego, steering = move_ego(at.scene, at.steering, world.road, world.idm, world.steering, PHYSICS_STEP_S)
    moved = moved.with_first(ego)
    # On a CPU asking costs nothing and spares the copies; on a GPU it would stall the queue.
    if at.running.device.type == "cpu" and bool(at.running.all()):
        return moved, traffic, steering
    frozen = torch.where(at.running, steering, at.steering)
    return moved.where(at.running, at.vehicles), where(at.running, traffic, at.traffic), frozen


def substep(world: World, state: TensorDictBase, at: Substep) -> Substep:
    """One physics step. Within it a hard crash comes before the goal, and both before the time-out."""
    vehicles, traffic, steering = move(world, state, at)
    scene = ego_scene(vehicles, world.road)
    ahead, behind = soft_crash_ahead(scene, world.ego), soft_crash_behind(scene, world.ego)
    crash = ego_overlaps(vehicles, world.road).any(-1) & at.running
    goal = (vehicles.x[:, EGO_INDEX] >= world.episode.goal_m) & at.running & ~crash
    step = at.step + at.running
    late = step >= round(world.episode.timeout_s / PHYSICS_STEP_S)
    return Substep(
        vehicles=vehicles,
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


def drive(world: World, state: TensorDictBase, ordered: Command, recorder: Recorder | None) -> Substep:
    """All physics steps of a decision."""
    at = begin(world, state, ordered)
    for _ in range(world.episode.substeps()):
        if at.running.device.type == "cpu" and not bool(at.running.any()):
            break
        running = at.running
        at = substep(world, state, at)
        if recorder is not None:
            recorder(at.vehicles, running)
    return at


def remember(world: World, state: TensorDictBase, at: Substep, ordered: Command) -> dict[str, Tensor]:
    """The ego's memory after a decision, each [N]."""
    before, ego = state.get(keys.EGO), at.vehicles.at(EGO_INDEX)
    arrived = settled(at.vehicles.columns(slice(0, 1)), world.road)[:, 0]
    direction = torch.where(arrived, 0, ordered.direction)
    seconds = (at.step - state.get(keys.STEP)).clamp_min(1).to(ego.speed.dtype) * PHYSICS_STEP_S
    start_speed = state.get(keys.VEHICLES).get("speed")[:, EGO_INDEX]
    return {
        "steering": at.steering,
        "mean_acceleration": (ego.speed - start_speed) / seconds,
        "change_progress": change_progress(ego, direction, world.road),
        "distance": ego.x,
        "change_direction": direction,
        "decisions": before.get("decisions") + 1,
        "lane_changes": before.get("lane_changes") + ordered.starts,
        "soft_crash": at.ahead,
        "soft_crash_behind": at.behind,
        "started_change": ordered.starts,
    }


def outcome(at: Substep, ordered: Command) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Events and done flags of a decision, each [N, 1]; exactly one reason for every end."""
    terminated = at.goal | at.hard_crash | ordered.off_road
    timeout = ~at.running & ~terminated
    events = {
        "goal": at.goal,
        "hard_crash": at.hard_crash,
        "out_of_road": ordered.off_road,
        "timeout": timeout,
        "scene_end": torch.zeros_like(timeout),
        keys.SOFT_CRASH: at.onsets,
        keys.SOFT_CRASH_BEHIND: at.onsets_behind,
    }
    flags = {"terminated": terminated, "truncated": timeout, "done": terminated | timeout}
    return {name: value[:, None] for name, value in events.items()}, {k: v[:, None] for k, v in flags.items()}
