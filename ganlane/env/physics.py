"""The ego in one physics step, and the outcome of a decision: pure functions on tensors.

Each compiles to one graph (:meth:`Physics.compile`).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ganlane import keys
from ganlane.keys import EGO_INDEX, PHYSICS_STEP_S
from ganlane.parameters.driving import EgoParameters, IdmParameters
from ganlane.parameters.episode import EpisodeParameters
from ganlane.runtime import check_compiler, compiled
from ganlane.sim.collisions import ego_overlaps
from ganlane.sim.dynamics import SteeringParameters
from ganlane.sim.ego import Command, apply_action, change_progress, ego_scene, ego_surroundings, move_ego
from ganlane.sim.idm import following_acceleration
from ganlane.sim.lanes import lane_change_done
from ganlane.sim.recycle import recycle
from ganlane.sim.state import Road, Vehicles

#: Name to tensor [N]: the ego's memory (:mod:`ganlane.env.state`).
EgoMemory = dict[str, Tensor]


class Rules(NamedTuple):
    """Constants of an episode: the road, the ego's parameters, and when an episode ends."""

    road: Road
    ego: EgoParameters
    episode: EpisodeParameters
    idm: IdmParameters
    steering: SteeringParameters
    #: Physics steps [N] after which a recorded scene ends; None: never.
    scene_steps: Tensor | None = None


def scene_over(rules: Rules, step: Tensor) -> Tensor:
    """Whether the recorded scene has ended at physics step ``step``, bool [N]."""
    return torch.zeros_like(step, dtype=torch.bool) if rules.scene_steps is None else step >= rules.scene_steps


class Substep(NamedTuple):
    """State between two physics steps of a decision; fields [N] except the vehicles [N, M].

    ``acceleration`` is the ego's for the next step, m/s2. ``ahead`` and ``behind`` are its soft crashes, ``onsets``
    counts their beginnings.
    """

    vehicles: Vehicles
    acceleration: Tensor
    steering: Tensor
    ahead: Tensor
    behind: Tensor
    step: Tensor
    running: Tensor
    onsets: Tensor
    onsets_behind: Tensor
    hard_crash: Tensor
    goal: Tensor


def begin(rules: Rules, action: Tensor, vehicles: Vehicles, ego: EgoMemory, step: Tensor) -> tuple[Substep, Command]:
    """The first moment of a decision, before anything moves. Rows whose command leaves the road have ended."""
    lanes = rules.road.lanes if isinstance(rules.road.lanes, int) else rules.road.lanes[:, 0]
    target, direction = vehicles.target_lane[:, EGO_INDEX], ego["change_direction"]
    command = apply_action(action, target, direction, lanes, rules.ego.abort_lane_change)
    targets = torch.cat((command.target_lane[:, None], vehicles.target_lane[:, 1:]), dim=1)
    vehicles = vehicles.with_(target_lane=targets)
    none = torch.zeros_like(command.off_road)
    start = Substep(
        vehicles=vehicles,
        acceleration=following_acceleration(ego_scene(vehicles, rules.road), rules.idm)[:, 0],
        steering=ego["steering"],
        ahead=ego["soft_crash"],
        behind=ego["soft_crash_behind"],
        step=step,
        running=~command.off_road,
        onsets=none.long(),
        onsets_behind=none.long(),
        hard_crash=none,
        goal=none,
    )
    return start, command


def advance(rules: Rules, before: Substep, moved: Vehicles, all_running: bool) -> Substep:
    """One physics step in which the others have ``moved``: moves the ego and finds the events.

    A hard crash has precedence over the goal, and both over the time-out. With ``all_running`` no row has ended,
    which saves the copies that keep ended rows as they are.
    """
    ego, steering = move_ego(
        before.vehicles, before.acceleration, before.steering, rules.road, rules.steering, PHYSICS_STEP_S
    )
    running, vehicles = before.running, moved.with_first(ego)
    if not all_running:
        vehicles = vehicles.where(running, before.vehicles)
        steering = torch.where(running, steering, before.steering)
    acceleration, ahead, behind = ego_surroundings(ego_scene(vehicles, rules.road), rules.idm, rules.ego)
    crash = ego_overlaps(vehicles, rules.road).any(-1) & running
    goal = (vehicles.x[:, EGO_INDEX] >= rules.episode.goal_m) & running & ~crash
    step = before.step + running
    late = (step >= round(rules.episode.timeout_s / PHYSICS_STEP_S)) | scene_over(rules, step)
    return Substep(
        vehicles=vehicles,
        acceleration=acceleration,
        steering=steering,
        ahead=torch.where(running, ahead, before.ahead),
        behind=torch.where(running, behind, before.behind),
        step=step,
        running=running & ~(crash | goal | late),
        onsets=before.onsets + (ahead & ~before.ahead & running),
        onsets_behind=before.onsets_behind + (behind & ~before.behind & running),
        hard_crash=before.hard_crash | crash,
        goal=before.goal | goal,
    )


def remember(rules: Rules, before: EgoMemory, start: Substep, end: Substep, command: Command) -> EgoMemory:
    """The ego's memory after a decision from ``start`` to ``end``."""
    ego, speed = end.vehicles.at(EGO_INDEX), start.vehicles.speed[:, EGO_INDEX]
    arrived = lane_change_done(end.vehicles.columns(slice(0, 1)), rules.road)[:, 0]
    direction = torch.where(arrived, 0, command.direction)
    seconds = (end.step - start.step).clamp_min(1).to(ego.speed.dtype) * PHYSICS_STEP_S
    return {
        "steering": end.steering,
        "mean_acceleration": (ego.speed - speed) / seconds,
        "change_progress": change_progress(ego, direction, rules.road),
        "distance": ego.x,
        "change_direction": direction,
        "decisions": before["decisions"] + 1,
        "lane_changes": before["lane_changes"] + command.starts,
        "soft_crash": end.ahead,
        "soft_crash_behind": end.behind,
        "started_change": command.starts,
    }


def outcome(rules: Rules, end: Substep, command: Command) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Events and done flags of a decision, each [N, 1]; every end has exactly one reason."""
    terminated = end.goal | end.hard_crash | command.off_road
    truncated = ~end.running & ~terminated
    scene_end = truncated & scene_over(rules, end.step)
    events = {
        "goal": end.goal,
        "hard_crash": end.hard_crash,
        "out_of_road": command.off_road,
        "timeout": truncated & ~scene_end,
        "scene_end": scene_end,
        keys.SOFT_CRASH: end.onsets,
        keys.SOFT_CRASH_BEHIND: end.onsets_behind,
    }
    flags = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
    return {name: value[:, None] for name, value in events.items()}, {k: v[:, None] for k, v in flags.items()}


class Physics:
    """The functions above, not compiled until :meth:`compile`."""

    def __init__(self) -> None:
        self.compiled = False
        self.begin, self.remember, self.recycle, self._advance = begin, remember, recycle, advance

    def compile(self) -> None:
        """Compile each function to a graph.

        Raises:
            UserError: there is no C++ compiler.
        """
        check_compiler()
        self.compiled = True
        for name in ("begin", "remember", "recycle", "_advance"):
            setattr(self, name, compiled(getattr(self, name)))

    def advance(self, rules: Rules, before: Substep, moved: Vehicles, all_running: bool) -> Substep:
        """As the function. In a graph the copies cost nothing, so one graph serves both cases."""
        return self._advance(rules, before, moved, all_running and not self.compiled)
