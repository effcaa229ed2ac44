"""One decision of the ego through its physics steps.

The ego in one physics step and the outcome of a decision are pure functions on tensors;
:func:`run_decision` joins them with the traffic.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.keys import EGO_INDEX, PHYSICS_STEP_S
from ganlane.settings.actions import CONTINUOUS, LANE_SPEED, ActionParameters
from ganlane.settings.driving import (
    EgoParameters,
    IdmParameters,
    MobilParameters,
    SteeringParameters,
)
from ganlane.settings.episode import EpisodeParameters
from ganlane.sim.actions import apply_controls, commanded_speed
from ganlane.sim.collisions import ego_overlaps
from ganlane.sim.dynamics import (
    Command,
    apply_action,
    change_progress,
    drive,
    ego_scene,
    ego_surroundings,
)
from ganlane.sim.idm import following_acceleration
from ganlane.sim.lane_ends import at_exit, hits_wall, leaves_road, ways_out
from ganlane.sim.mobil import TABLE_IV, falling_behind, letting_past
from ganlane.sim.neighbours import Scene
from ganlane.sim.state import Road, Vehicles, lane_change_done, reads_are_cheap
from ganlane.traffic.base import TrafficModule, memory_of, new_tensordict, where_rows, with_rows

#: Fields of the state by their names (:mod:`ganlane.env.state`), [N] or [N, 1].
Fields = dict[str, Tensor]
#: In place of the number of an event of :data:`ganlane.keys.END_EVENTS`: the episode goes on.
RUNNING = -1
#: Called after every physics step with the vehicles and the rows [N] that were running in it.
Recorder = Callable[[Vehicles, Tensor], None]


class Rules(NamedTuple):
    """Constants of an episode: the road, the ego's parameters, and when an episode ends."""

    road: Road
    ego: EgoParameters
    episode: EpisodeParameters
    idm: IdmParameters
    steering: SteeringParameters
    actions: ActionParameters = ActionParameters()
    #: How the ego falls behind before a lane change that it has to make.
    mobil: MobilParameters = TABLE_IV
    #: Physics steps [N] after which a recorded scene ends; None: never.
    scene_steps: Tensor | None = None


class Substep(NamedTuple):
    """State between two physics steps of a decision; fields [N] except the vehicles [N, M].

    Attributes:
        acceleration: the ego's for the next step, m/s2.
        steering: its steering angle, rad.
        line: lateral position that it steers to, m.
        ahead, behind: whether it is in a soft crash, bool.
        step: physics steps since the start of the episode, int64.
        onsets, onsets_behind: soft crashes that have begun in this decision, int64.
        end: number of the event that has ended the episode in :data:`ganlane.keys.END_EVENTS`, or
            :data:`RUNNING`.
    """

    vehicles: Vehicles
    acceleration: Tensor
    steering: Tensor
    line: Tensor
    ahead: Tensor
    behind: Tensor
    step: Tensor
    onsets: Tensor
    onsets_behind: Tensor
    end: Tensor

    @property
    def running(self) -> Tensor:
        """Whether the episode of each row goes on, bool [N]."""
        return self.end == RUNNING


def begin(
    rules: Rules,
    action: Tensor,
    vehicles: Vehicles,
    ego: Fields,
    step: Tensor,
) -> tuple[Substep, Command]:
    """The first moment of a decision, before anything moves, and what the action commands.

    Rows whose command leaves the road have ended.

    Args:
        action: [N] int64, or [N, 2] for ``continuous``.
        vehicles: [N, M].
        ego: its memory of the last decision, [N] each.
        step: physics steps since the start of the episode, [N] int64.
    """
    # The command sets the lane that the ego steers to; the motion itself takes several decisions.
    road = rules.road
    direction = ego["change_direction"]
    controls = None
    if rules.actions.form == CONTINUOUS:
        period_s = rules.episode.decision_period_s
        controls = apply_controls(action, vehicles, direction, road, rules.actions, period_s)
        command = controls.command
    else:
        command = apply_action(action, vehicles, direction, road, rules.ego.abort_lane_change)

    if rules.actions.form == LANE_SPEED:
        # Within the decision this is the speed that the ego desires, for all who look at it.
        desired = vehicles.desired_speed
        highest = desired[:, EGO_INDEX]
        speed = commanded_speed(action, ego[keys.SET_SPEED], highest, rules.actions)
        vehicles = vehicles.with_(desired_speed=with_ego(speed, desired))
    target_lane = with_ego(command.target_lane, vehicles.target_lane)
    vehicles = vehicles.with_(target_lane=target_lane)

    if controls is not None:
        line = controls.line
        acceleration = controls.acceleration
    else:
        # To the centre of the target lane, behind whoever is ahead by IDM.
        line = road.centre_of(command.target_lane[:, None], vehicles.y.dtype)[:, 0]
        scene = ego_scene(vehicles, road)
        acceleration = following_acceleration(scene, rules.idm)[:, 0]
        acceleration = before_change(rules, scene, acceleration)

    none = torch.zeros_like(step)
    start = Substep(
        vehicles=vehicles,
        acceleration=acceleration,
        steering=ego["steering"],
        line=line,
        ahead=ego["soft_crash"],
        behind=ego["soft_crash_behind"],
        step=step,
        onsets=none,
        onsets_behind=none,
        end=torch.where(command.off_road, keys.END_EVENTS.index("out_of_road"), RUNNING),
    )
    return start, command


def before_change(rules: Rules, scene: Scene, acceleration: Tensor) -> Tensor:
    """The ego's ``acceleration`` [N], or less where it has to leave its lane soon; m/s2.

    ``scene`` has the ego as its only observer.
    """
    if not rules.road.has_lane_ends or rules.mobil.courtesy == 0.0:
        return acceleration

    ways = ways_out(scene.observers, rules.road, rules.mobil.mandatory_m)
    behind = falling_behind(scene, ways, rules.idm, rules.mobil)
    # The ego cannot know whether those behind it make room.
    past = letting_past(scene, ways, rules.idm, rules.mobil)
    courteous = torch.minimum(behind, past)[:, 0]
    return torch.minimum(acceleration, courteous)


def with_ego(number: Tensor, numbers: Tensor) -> Tensor:
    """``numbers`` [N, M] with those of the ego replaced by ``number`` [N]."""
    return torch.cat((number[:, None], numbers[:, 1:]), dim=1)


def endings(
    rules: Rules,
    before: Vehicles,
    vehicles: Vehicles,
    scene: Scene,
    step: Tensor,
) -> Fields:
    """What may have ended an episode in the step from ``before`` to ``vehicles``, bool [N] by name.

    The first that is true is the reason: a hard crash has precedence over leaving the road, that
    over goal and missed exit, and all over the time-out.

    Args:
        scene: of the ego.
        step: physics steps of the episode, [N].
    """
    road = rules.road
    crash = ego_overlaps(vehicles, road).any(-1)
    if road.has_lane_ends:
        crash = crash | hits_wall(scene.observers, scene.body, road)[:, 0]
    events = {"hard_crash": crash}

    if rules.actions.form == CONTINUOUS:
        # Where the lane itself is commanded, the command alone can leave the road.
        # Columns [N, 1], as the numbers of roads that differ between rows.
        y = before.y[:, :1]
        new_y = vehicles.y[:, :1]
        x = vehicles.x[:, :1]
        events["out_of_road"] = leaves_road(road, y, new_y, x)[:, 0]

    ego = vehicles.at(EGO_INDEX)
    # On a road with an exit that is the goal, wherever it is.
    if road.exit_lane is None:
        events["goal"] = ego.x >= rules.episode.goal_m
    else:
        events["goal"], events["missed_exit"] = at_exit(ego, road)

    if rules.scene_steps is not None:
        events["scene_end"] = step >= rules.scene_steps
    events["timeout"] = step >= round(rules.episode.timeout_s / PHYSICS_STEP_S)
    return events


def advance(rules: Rules, before: Substep, moved: Vehicles, all_running: bool) -> Substep:
    """One physics step in which the others have ``moved``: moves the ego and finds the events.

    With ``all_running`` no row has ended, which saves the copies that keep ended rows as they are.
    """
    ego, steering = drive(
        before.vehicles.at(EGO_INDEX),
        before.acceleration,
        before.steering,
        before.line,
        PHYSICS_STEP_S,
        rules.steering,
    )

    # The others moved while they saw the ego where it was: all move at once, from one state.
    running = before.running
    vehicles = moved.with_first(ego)
    if not all_running:
        vehicles = vehicles.where(running, before.vehicles)
        steering = torch.where(running, steering, before.steering)

    # What the ego meets where it is now, and how it goes on from there.
    scene = ego_scene(vehicles, rules.road)
    acceleration, ahead, behind = ego_surroundings(scene, rules.idm, rules.ego)
    acceleration = before_change(rules, scene, acceleration)
    if rules.actions.form == CONTINUOUS:
        # The command holds for the whole decision.
        acceleration = before.acceleration

    # The first event in the order of precedence ends the episode.
    step = before.step + running
    end = before.end
    events = endings(rules, before.vehicles, vehicles, scene, step)
    for name, happens in events.items():
        ends_now = (end == RUNNING) & happens
        end = torch.where(ends_now, keys.END_EVENTS.index(name), end)

    return Substep(
        vehicles=vehicles,
        acceleration=acceleration,
        steering=steering,
        line=before.line,
        ahead=torch.where(running, ahead, before.ahead),
        behind=torch.where(running, behind, before.behind),
        step=step,
        # A soft crash counts when it begins, however long it lasts.
        onsets=before.onsets + (ahead & ~before.ahead & running),
        onsets_behind=before.onsets_behind + (behind & ~before.behind & running),
        end=end,
    )


def remember(
    rules: Rules,
    before: Fields,
    start: Substep,
    end: Substep,
    command: Command,
) -> Fields:
    """The ego's memory after a decision from ``start`` to ``end``, fields [N].

    ``before`` is its memory at ``start``, ``command`` what it was told to do.
    """
    # Over the whole decision, which may have ended early.
    ego = end.vehicles.at(EGO_INDEX)
    speed = start.vehicles.speed[:, EGO_INDEX]

    # A column [N, 1], as the numbers of roads that differ between rows.
    column = end.vehicles.columns(slice(0, 1))
    arrived = lane_change_done(column, rules.road)[:, 0]
    direction = torch.where(arrived, 0, command.direction)

    # A row that ended at once drove no step: its speed did not change either.
    steps = (end.step - start.step).clamp_min(1)
    seconds = steps.to(ego.speed.dtype) * PHYSICS_STEP_S

    memory = {
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
    if rules.actions.form == LANE_SPEED:
        memory[keys.SET_SPEED] = end.vehicles.desired_speed[:, EGO_INDEX]
    return memory


def outcome(end: Substep) -> tuple[Fields, Fields]:
    """Events and done flags of a decision, each [N, 1]; every end has exactly one reason."""
    events = {name: end.end == number for number, name in enumerate(keys.END_EVENTS)}
    events[keys.SOFT_CRASH] = end.onsets
    events[keys.SOFT_CRASH_BEHIND] = end.onsets_behind

    # After the outcomes of the driving come the cut-offs.
    done = ~end.running
    truncated = end.end >= len(keys.TERMINAL_EVENTS)
    flags = {"terminated": done & ~truncated, "truncated": truncated, "done": done}
    return _columns(events), _columns(flags)


def _columns(values: Fields) -> Fields:
    """Fields [N] as [N, 1]."""
    return {name: value[:, None] for name, value in values.items()}


# A whole decision


def known_false(flag: Tensor) -> bool:
    """Whether ``flag`` can be read and is false."""
    return reads_are_cheap(flag) and not bool(flag)


class EndedRows:
    """The traffic's memory of the rows that end within a decision, as it was when they ended.

    The traffic goes on computing them, in vain: restoring their memory in every physics step would
    copy that of all rows each time. With traffic=gan and 512 rows a step then took 1.1 times as
    long.
    """

    def __init__(self) -> None:
        self.rows: list[Tensor] = []
        self.memories: list[TensorDictBase] = []

    def keep(self, ended: Tensor, memory: TensorDictBase) -> None:
        """Keep the ``memory`` of the rows [N] that have just ``ended``."""
        if ended.any():
            rows = ended.nonzero()[:, 0]
            self.rows.append(rows)
            # TorchRL drops empty parts between decisions, so the first moment's would differ from
            # later ones.
            self.memories.append(memory[rows].filter_empty_())

    def restore(self, memory: TensorDictBase) -> TensorDictBase:
        """``memory`` with the kept rows as they were; its tensors are not written to."""
        if not self.rows or memory.is_empty():
            return memory
        return with_rows(memory, torch.cat(self.rows), torch.cat(self.memories))  # type: ignore[arg-type]


def run_decision(
    traffic: TrafficModule,
    rules: Rules,
    state: TensorDictBase,
    start: Substep,
    key: Tensor,
    recorder: Recorder | None = None,
) -> tuple[Substep, TensorDictBase]:
    """All physics steps of a decision: where they lead, and the traffic's memory after it.

    Rows that end stay as they are. Their memory is put aside, or on a GPU, where finding them would
    wait for the queue, kept in every step.

    Args:
        traffic: moves the other vehicles.
        state, start: at the beginning of the decision, and its first moment.
        key: of the episodes, [N] int64.
        recorder: called after every physics step; None: nobody looks.
    """
    memory = memory_of(state)
    now = start
    ended = EndedRows()
    counters = {name: state.get(name) for name in (keys.SEED, keys.EPISODE)}
    counters[keys.EPISODE_KEY] = key
    n = memory.batch_size[0]

    can_read = reads_are_cheap(now.running)
    if can_read:
        ended.keep(~now.running, memory)

    for count in range(rules.episode.substeps()):
        before = now
        # On a CPU the remaining steps are left out once every row has ended.
        if known_false(before.running.any()):
            break

        # The traffic's clock continues in ended rows: stopped at a moment of decision it would make
        # these rows' drivers decide in all remaining steps, in vain.
        fields = {
            keys.VEHICLES: new_tensordict(before.vehicles.as_dict(), n),
            keys.TRAFFIC: memory,
            **counters,
            keys.STEP: start.step + count,
        }
        after = traffic(new_tensordict(fields, n))

        # Then the ego.
        all_running = known_false((~before.running).any())
        moved = Vehicles.of(after.get(keys.MOVED))
        now = advance(rules, before, moved, all_running)

        # The memory of ended rows: put aside when they end, or kept by a copy in every step.
        if can_read:
            memory = after.get(keys.TRAFFIC)
            ended.keep(before.running & ~now.running, memory)
        else:
            memory = after.get(keys.TRAFFIC).apply(partial(where_rows, before.running), memory)

        if recorder is not None:
            recorder(now.vehicles, before.running)
    return now, ended.restore(memory)
