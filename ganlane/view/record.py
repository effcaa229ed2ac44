"""A recorded episode, frame by frame as plain arrays, and recording one while it runs, at every physics step."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ganlane import keys
from ganlane.agents.drivers import GreedyPolicy
from ganlane.errors import UserError
from ganlane.evaluation.episodes import start_of
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.state import Road, Vehicles, road_in

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

ACTION_NAMES = ("keep", "left", "right")
#: A vehicle that moves further than this in a physics step was recycled (placed elsewhere), m.
JUMP_M = 30.0


@dataclass(frozen=True)
class EpisodeLabel:
    """Agent, traffic, road and numbers of an episode."""

    agent: str = "ego"
    traffic: str = "traffic"
    seed: int = 0
    episode: int = 0
    #: Number of lanes; lane 0 is the rightmost.
    lanes: int = 3
    lane_width_m: float = 4.0


@dataclass(frozen=True)
class Trajectory:
    """T frames of M vehicles; the ego has index 0.

    Frame 0 is the state after the reset. SI units: positions of the bodies' centres in m, ``x`` along the
    road, ``y`` to the left; ``heading`` in rad, anticlockwise.
    """

    label: EpisodeLabel
    #: Time since the reset, s, [T].
    time_s: FloatArray
    #: Fields of ``vehicles`` (:mod:`ganlane.keys`), each [T, M].
    x: FloatArray
    y: FloatArray
    heading: FloatArray
    speed: FloatArray
    acceleration: FloatArray
    length: FloatArray
    width: FloatArray
    target_lane: IntArray
    valid: BoolArray
    #: Action of the decision that a frame belongs to, [T]; -1 before the first decision.
    action: IntArray
    #: Return up to the decision before, [T]; the last frame has the whole return.
    returns: FloatArray
    #: End event, one of :data:`ganlane.keys.END_EVENTS`; empty where the episode was cut off.
    outcome: str = ""
    #: Action values of the policy, [T, A]; NaN before the first decision, empty if unknown.
    action_values: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    #: Reward of the decision that a frame belongs to, [T]; NaN before the first, empty if unknown.
    reward: FloatArray = field(default_factory=lambda: np.empty(0))
    #: Jerk, m/s3, [T, M], where frames before these were left out (:meth:`since`); empty otherwise.
    driven_jerk: FloatArray = field(default_factory=lambda: np.empty((0, 0)))

    #: Ends of the decisions with a soft crash, s; empty if unknown.
    soft_crash_s: FloatArray = field(default_factory=lambda: np.empty(0))

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def vehicles(self) -> int:
        """Number of vehicles M, the ego included."""
        return self.x.shape[1]

    @property
    def frame_s(self) -> float:
        """Time between two frames, s."""
        return float(np.median(np.diff(self.time_s))) if len(self) > 1 else keys.PHYSICS_STEP_S

    def lane(self) -> IntArray:
        """Lane whose centre is nearest, [T, M]."""
        nearest = np.rint(self.y / self.label.lane_width_m).astype(np.int64)
        return nearest.clip(0, self.label.lanes - 1)

    def jumped(self) -> BoolArray:
        """Whether a vehicle was recycled (placed elsewhere) since the frame before, [T, M]."""
        moved = np.abs(np.diff(self.x, axis=0, prepend=self.x[:1]))
        return moved > JUMP_M * max(1.0, self.frame_s / keys.PHYSICS_STEP_S)

    def jerk(self) -> FloatArray:
        """Change of the acceleration since the frame before, m/s3, [T, M].

        0 in the episode's first two frames and after a jump.
        """
        if self.driven_jerk.size:
            return self.driven_jerk
        change = np.diff(self.acceleration, axis=0, prepend=self.acceleration[:1]) / self.frame_s
        begins = np.arange(len(self))[:, None] < 2
        return np.where(begins | self.jumped(), 0.0, change)

    def comfort(self) -> dict[str, float]:
        """The ego's ``rms_acceleration`` and ``hardest_braking`` (0 or below), m/s2, and ``rms_jerk``, m/s3."""
        acceleration, jerk = self.acceleration[:, 0], self.jerk()[:, 0]
        return {
            "rms_acceleration": round(float(np.sqrt(np.mean(acceleration**2))), 3),
            "rms_jerk": round(float(np.sqrt(np.mean(jerk**2))), 3),
            "hardest_braking": round(min(0.0, float(acceleration.min())), 3),
        }

    def since(self, start_s: float) -> Trajectory:
        """The frames from ``start_s`` on.

        Raises:
            UserError: the episode is over by then.
        """
        first = int(np.searchsorted(self.time_s, start_s - 1e-9))
        if first == len(self):
            raise UserError(f"start at {start_s:g} s: the episode lasts {self.time_s[-1]:g} s; choose a part of it.")
        arrays = {each.name: getattr(self, each.name) for each in fields(self)} | {"driven_jerk": self.jerk()}
        later: dict[str, Any] = {
            name: value[first:]
            for name, value in arrays.items()
            if isinstance(value, np.ndarray) and value.size and name != "soft_crash_s"
        }
        return replace(self, **later)

    def overlapping(self) -> BoolArray:
        """Whether a vehicle's box overlaps another's, [T, M]."""
        fields = {name: torch.as_tensor(getattr(self, name)) for name in ("x", "y", "heading", "length", "width")}
        unused = torch.zeros_like(fields["x"])
        others = {name: unused for name in keys.VEHICLE_FIELDS if name not in fields}
        everybody = Vehicles(**{**others, **fields, "valid": torch.as_tensor(self.valid)})
        return pair_overlaps(everybody).any(-1).numpy()


# Recording

#: Fields of ``vehicles`` that a trajectory keeps, with their types.
_FIELDS = {
    **dict.fromkeys(("x", "y", "heading", "speed", "acceleration", "length", "width"), np.float64),
    "target_lane": np.int64,
    "valid": np.bool_,
}


@dataclass
class Recorder:
    """Collects frames of one row; the environment calls it after each physics step."""

    row: int = 0
    frames: list[dict[str, np.ndarray]] = field(default_factory=list)
    time_s: list[float] = field(default_factory=list)
    action: list[int] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    action_values: list[np.ndarray] = field(default_factory=list)
    #: Frames recorded by the end of each decision, and its reward; empty if rewards are not recorded.
    decisions: list[tuple[int, float]] = field(default_factory=list)
    #: Ends of the decisions with a soft crash, s.
    soft_crash_s: list[float] = field(default_factory=list)
    current_action: int = -1
    current_return: float = 0.0
    current_values: np.ndarray = field(default_factory=lambda: np.empty(0))

    def __call__(self, vehicles: Vehicles | TensorDictBase | Any, running: Tensor) -> None:
        """Hook of the environment: vehicles [N, M] after a physics step, ``running`` [N] the rows that took it."""
        if bool(running[self.row]):
            self.add(vehicles, keys.PHYSICS_STEP_S)

    def add(self, vehicles: Vehicles | TensorDictBase | Any, elapsed_s: float) -> None:
        """Append a frame, ``elapsed_s`` after the one before."""
        state = vehicles.as_dict() if isinstance(vehicles, Vehicles) else vehicles
        self.frames.append(
            {name: state[name][self.row].detach().cpu().numpy().astype(kind) for name, kind in _FIELDS.items()}
        )
        self.time_s.append(self.time_s[-1] + elapsed_s if self.time_s else 0.0)
        self.action.append(self.current_action)
        self.returns.append(self.current_return)
        self.action_values.append(self.current_values)

    def keep_last(self, count: int) -> None:
        """Forget all frames but the last ``count``."""
        for kept in (self.frames, self.time_s, self.action, self.returns, self.action_values):
            del kept[:-count]

    def trajectory(self, label: EpisodeLabel, outcome: str = "") -> Trajectory:
        """The frames so far; the last one shows the return after the last decision."""
        reward = np.full(len(self.frames) if self.decisions else 0, np.nan)
        begin = 1
        for end, paid in self.decisions:
            reward[begin:end], begin = paid, end
        width = max(len(values) for values in self.action_values)
        values = [values if len(values) else np.full(width, np.nan) for values in self.action_values]
        return Trajectory(
            label=label,
            time_s=np.array(self.time_s).round(6),
            **{name: np.stack([frame[name] for frame in self.frames]) for name in _FIELDS},
            action=np.array(self.action),
            returns=np.array([*self.returns[:-1], self.current_return]),
            outcome=outcome,
            action_values=np.stack(values) if width else np.empty((0, 0)),
            reward=reward,
            soft_crash_s=np.array(self.soft_crash_s),
        )


def road_of_row(state: TensorDictBase, road: Road, row: int) -> tuple[int, float]:
    """Lanes and lane width, m, of a row: of its replayed scene if ``state`` has one, else of ``road``."""
    found = road_in(state, road)
    lanes, width = (torch.as_tensor(value).flatten() for value in (found.lanes, found.lane_width_m))
    return int(lanes[min(row, len(lanes) - 1)]), float(width[min(row, len(width) - 1)])


def outcome_of(state: TensorDictBase, row: int = 0) -> str:
    """The event that ended the episode of a row; empty where none did."""
    events = state[keys.EVENTS]
    return next((name for name in keys.END_EVENTS if bool(events[name][row])), "")


@contextmanager
def _recording(base: Any, recorder: Recorder) -> Iterator[None]:
    """Install the recorder in the environment for a while."""
    if not hasattr(base, "recorder"):
        raise UserError(f"env={type(base).__name__}: it cannot be recorded; expected a HighwayEnv of this process.")
    before, base.recorder = base.recorder, recorder
    try:
        yield
    finally:
        base.recorder = before


def record_episode(
    env: EnvBase,
    policy: TensorDictModuleBase,
    seed: int,
    episode: int,
    agent: str = "ego",
    traffic: str = "traffic",
    max_time_s: float = float("inf"),
) -> Trajectory:
    """Drive one episode to its end and record it at every physics step.

    Args:
        env: batched environment; all rows run the episode, row 0 is recorded. One row is enough.
        policy: writes ``action``; acts deterministically.
        seed, episode: the episode's numbers.
        agent, traffic: names for the label.
        max_time_s: stop after this much simulated time; the outcome is then empty.

    Raises:
        UserError: the environment, below its transforms, is no ``HighwayEnv``.
    """
    base: Any = env
    while hasattr(base, "base_env"):
        base = base.base_env
    recorder = Recorder()
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC), _recording(base, recorder):
        state = env.reset(start_of(env, [episode], seed))
        label = EpisodeLabel(agent, traffic, seed, episode, *road_of_row(state, base.road, 0))
        recorder.add(state[keys.VEHICLES], 0.0)
        outcome, done = "", False
        while not done and recorder.time_s[-1] < max_time_s - 1e-6:
            state = _decide(env, policy, policy(state), recorder)
            done = bool(state["done"][0])
            outcome = outcome_of(state) if done else ""
    return recorder.trajectory(label, outcome)


def _decide(env: EnvBase, policy: TensorDictModuleBase, state: TensorDictBase, recorder: Recorder) -> TensorDictBase:
    """One decision; the state after it."""
    recorder.current_action = int(state[keys.ACTION][0])
    # Action values [N, A]: from the policy's network, or its output; None if it has none.
    is_greedy = isinstance(policy, GreedyPolicy)
    values = policy.network.values(state[keys.OBSERVATION]) if is_greedy else state.get("action_value", None)
    if values is not None and values.ndim == 2:
        recorder.current_values = values[0].double().cpu().numpy()
    stepped = env.step(state)
    reward = float(stepped["next", keys.REWARD][0])
    recorder.current_return += reward
    recorder.decisions.append((len(recorder.frames), reward))
    if int(stepped["next", keys.EVENTS, keys.SOFT_CRASH][0]) > 0:
        recorder.soft_crash_s.append(recorder.time_s[-1])
    return env.step_mdp(stepped)
