"""What happens to the ego in one physics step, and what a decision led to: pure functions on tensors.

Each of them compiles to one graph (:meth:`Physics.compile`).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ganlane import keys
from ganlane.env.rules import Rules, scene_over
from ganlane.keys import EGO_INDEX, PHYSICS_STEP_S
from ganlane.runtime import check_compiler, compiled
from ganlane.sim.collisions import ego_overlaps
from ganlane.sim.ego import (
    Command,
    change_progress,
    ego_scene,
    look_around,
    move_ego,
    obey,
)
from ganlane.sim.following import following_acceleration
from ganlane.sim.lanes import settled
from ganlane.sim.recycle import recycle
from ganlane.sim.vehicles import Vehicles

#: Name to tensor [N]: the ego's memory (:mod:`ganlane.env.state`).
EgoMemory = dict[str, Tensor]


class Substep(NamedTuple):
    """What is carried from one physics step to the next within a decision; fields [N] but for the vehicles.

    ``acceleration`` is what the ego's driver wants next, m/s2. ``ahead`` and ``behind`` say whether the ego is
    dangerously close, ``onsets`` count how often that began.
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
    """A decision's first moment: the command is given, nothing has moved. Who leaves the road is not running."""
    lanes = rules.road.lanes if isinstance(rules.road.lanes, int) else rules.road.lanes[:, 0]
    target, direction = vehicles.target_lane[:, EGO_INDEX], ego["change_direction"]
    ordered = obey(action, target, direction, lanes, rules.ego.abort_lane_change)
    targets = torch.cat((ordered.target_lane[:, None], vehicles.target_lane[:, 1:]), dim=1)
    vehicles = vehicles.with_(target_lane=targets)
    none = torch.zeros_like(ordered.off_road)
    start = Substep(
        vehicles=vehicles,
        acceleration=following_acceleration(ego_scene(vehicles, rules.road), rules.idm)[:, 0],
        steering=ego["steering"],
        ahead=ego["soft_crash"],
        behind=ego["soft_crash_behind"],
        step=step,
        running=~ordered.off_road,
        onsets=none.long(),
        onsets_behind=none.long(),
        hard_crash=none,
        goal=none,
    )
    return start, ordered


def advance(rules: Rules, at: Substep, moved: Vehicles, everybody: bool) -> Substep:
    """One physics step, the others having ``moved``: the ego follows, then it is seen what that led to.

    Within a step a hard crash comes before the goal, and both before the time-out. ``everybody`` says that no row
    has ended, which spares the copies that keep such rows as they are.
    """
    ego, steering = move_ego(at.vehicles, at.acceleration, at.steering, rules.road, rules.steering, PHYSICS_STEP_S)
    vehicles = moved.with_first(ego)
    if not everybody:
        vehicles = vehicles.where(at.running, at.vehicles)
        steering = torch.where(at.running, steering, at.steering)
    acceleration, ahead, behind = look_around(ego_scene(vehicles, rules.road), rules.idm, rules.ego)
    crash = ego_overlaps(vehicles, rules.road).any(-1) & at.running
    goal = (vehicles.x[:, EGO_INDEX] >= rules.episode.goal_m) & at.running & ~crash
    step = at.step + at.running
    late = (step >= round(rules.episode.timeout_s / PHYSICS_STEP_S)) | scene_over(rules, step)
    return Substep(
        vehicles=vehicles,
        acceleration=acceleration,
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


def remember(
    rules: Rules, before: EgoMemory, speed: Tensor, step: Tensor, at: Substep, ordered: Command
) -> EgoMemory:
    """The ego's memory after a decision that began at ``speed`` (m/s) and physics step ``step``, both [N]."""
    ego = at.vehicles.at(EGO_INDEX)
    arrived = settled(at.vehicles.columns(slice(0, 1)), rules.road)[:, 0]
    direction = torch.where(arrived, 0, ordered.direction)
    seconds = (at.step - step).clamp_min(1).to(ego.speed.dtype) * PHYSICS_STEP_S
    return {
        "steering": at.steering,
        "mean_acceleration": (ego.speed - speed) / seconds,
        "change_progress": change_progress(ego, direction, rules.road),
        "distance": ego.x,
        "change_direction": direction,
        "decisions": before["decisions"] + 1,
        "lane_changes": before["lane_changes"] + ordered.starts,
        "soft_crash": at.ahead,
        "soft_crash_behind": at.behind,
        "started_change": ordered.starts,
    }


def outcome(rules: Rules, at: Substep, ordered: Command) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Events and done flags of a decision, each [N, 1]; exactly one reason for every end."""
    terminated = at.goal | at.hard_crash | ordered.off_road
    truncated = ~at.running & ~terminated
    scene_end = truncated & scene_over(rules, at.step)
    events = {
        "goal": at.goal,
        "hard_crash": at.hard_crash,
        "out_of_road": ordered.off_road,
        "timeout": truncated & ~scene_end,
        "scene_end": scene_end,
        keys.SOFT_CRASH: at.onsets,
        keys.SOFT_CRASH_BEHIND: at.onsets_behind,
    }
    flags = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
    return {name: value[:, None] for name, value in events.items()}, {k: v[:, None] for k, v in flags.items()}


class Physics:
    """The functions above, eager until :meth:`compile`."""

    def __init__(self) -> None:
        self.compiled = False
        self.begin, self.remember, self.recycle, self._advance = begin, remember, recycle, advance

    def compile(self) -> None:
        """Make a graph of each.

        Raises:
            UserError: there is no C++ compiler.
        """
        check_compiler()
        self.compiled = True
        for name in ("begin", "remember", "recycle", "_advance"):
            setattr(self, name, compiled(getattr(self, name)))

    def advance(self, rules: Rules, at: Substep, moved: Vehicles, everybody: bool) -> Substep:
        """As the function. In a graph the copies cost nothing, so there is one graph for both cases."""
        return self._advance(rules, at, moved, everybody and not self.compiled)
