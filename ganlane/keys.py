"""Every TensorDict key, declared once.

N environments, M vehicles, the ego at index 0; floats in the run's dtype, SI units.

======================================  ==========  ==============================================
``vehicles.x, y``                       [N, M]      centre of the body, m; x along the road, y to
                                                    the left
``vehicles.heading``                    [N, M]      rad, relative to the road, anticlockwise
``vehicles.speed, acceleration``        [N, M]      m/s, m/s2
``vehicles.length, width``              [N, M]      m, fixed for an episode
``vehicles.desired_speed``              [N, M]      m/s, fixed for an episode
``vehicles.target_lane``                [N, M] i64  the lane it keeps or is moving to; 0 is the
                                                    rightmost
``vehicles.visibility``                 [N, M] i64  0 centre, 1 body, 2 signalled
                                                    (:mod:`ganlane.sim.state`)
``vehicles.valid``                      [N, M] b    false is padding: never seen, hit or counted
``ego.*``                               [N]         the environment's memory of the ego
``traffic.*``                           free        the traffic module's memory
``seed, episode, step``                 [N] i64     they determine every random number; step: 0.1 s
``road.lanes``                          [N, 1] i64  only where every row has its own road (replay)
``road.lane_width_m``                   [N, 1]      the same, m
``events.*``                            [N, 1]      events of the last decision
``action``                              [N] i64     0 keep, 1 left, 2 right (``env.actions=lane``;
                                                    :mod:`ganlane.settings.actions`)
``action_mask``                         [N, A] b    which of them are allowed, where there is a mask
======================================  ==========  ==============================================
"""

from __future__ import annotations

from typing import Final

VEHICLES: Final = "vehicles"
MOVED: Final = "moved"
TRAFFIC: Final = "traffic"
EGO: Final = "ego"
EVENTS: Final = "events"
ROAD: Final = "road"
REWARD_TERMS: Final = "reward_terms"
SEED: Final = "seed"
EPISODE: Final = "episode"
STEP: Final = "step"
#: Keys of the episodes [N] int64 (:func:`ganlane.sim.random.episode_key`), for the traffic.
EPISODE_KEY: Final = "episode_key"
ACTION: Final = "action"
#: Value of the chosen action by the policy, if it writes one, [N] or [N, 1]; named as in TorchRL.
CHOSEN_VALUE: Final = "chosen_action_value"
OBSERVATION: Final = "observation"
#: Which actions are allowed, [N, 3] bool, where the environment has a mask; named as in TorchRL.
ACTION_MASK: Final = "action_mask"
#: Whether even keeping the lane makes a driver brake harder than is safe, [N, 1] bool (mask
#: ``safe``).
NO_SAFE_ACTION: Final = "no_safe_action"
REWARD: Final = "reward"

#: Float fields of ``vehicles``.
VEHICLE_FLOATS: Final = (
    "x",
    "y",
    "heading",
    "speed",
    "acceleration",
    "length",
    "width",
    "desired_speed",
)
#: Integer fields of ``vehicles``.
VEHICLE_INTEGERS: Final = ("target_lane", "visibility")
#: Boolean fields of ``vehicles``.
VEHICLE_FLAGS: Final = ("valid",)
VEHICLE_FIELDS: Final = VEHICLE_FLOATS + VEHICLE_INTEGERS + VEHICLE_FLAGS

#: Boolean events that are outcomes of the driving.
TERMINAL_EVENTS: Final = ("goal", "hard_crash", "out_of_road", "missed_exit")
#: And cut-offs.
TRUNCATING_EVENTS: Final = ("timeout", "scene_end")
#: A decision ends for at most one of them.
END_EVENTS: Final = TERMINAL_EVENTS + TRUNCATING_EVENTS
#: Number of soft-crash onsets in the decision, int64.
SOFT_CRASH: Final = "soft_crash"
#: The same behind the ego: reported, and penalised by ``reward=considerate`` alone.
SOFT_CRASH_BEHIND: Final = "soft_crash_behind"
EVENT_COUNTS: Final = (SOFT_CRASH, SOFT_CRASH_BEHIND)
DONE_FLAGS: Final = ("done", "terminated", "truncated")

#: Of ``ego``: steering angle (rad), mean acceleration in the last decision (m/s2), lane change
#: progress (0 to 1), distance (m).
EGO_FLOATS: Final = ("steering", "mean_acceleration", "change_progress", "distance")
#: And with ``env.actions=lane_speed`` the speed that it aims at, m/s.
SET_SPEED: Final = "set_speed"
#: Direction of the current lane change (-1, 0, 1), decisions and started lane changes in this
#: episode.
EGO_INTEGERS: Final = ("change_direction", "decisions", "lane_changes")
#: Soft crash in the last physics step (ahead, behind), lane change started in the last decision.
EGO_FLAGS: Final = ("soft_crash", "soft_crash_behind", "started_change")

#: Terms of the paper's reward; one that charges for ``soft_crash_behind`` has a further one of that
#: name.
REWARD_TERM_NAMES: Final = (
    "speed",
    "lane_change",
    "out_of_road",
    "hard_crash",
    "soft_crash",
    "goal",
)

KEEP: Final = 0
LEFT: Final = 1
RIGHT: Final = 2
#: Number of actions.
ACTIONS: Final = 3
EGO_INDEX: Final = 0
PHYSICS_STEP_S: Final = 0.1
