"""Episodes recorded at every physics step.

As plain arrays, while they run, and as tracks of recorded traffic.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import polars as pl
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ganlane import keys
from ganlane.agents.drivers import GreedyPolicy
from ganlane.data.recordings import scene_csv, write_prepared
from ganlane.data.schema import SCHEMA, TRACK_STRIDE, sort
from ganlane.errors import UserError
from ganlane.evaluation.episodes import start_of
from ganlane.files import atomic_path
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.state import Road, Vehicles, road_in

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

ACTION_NAMES = ("keep", "left", "right")
#: A vehicle that moves further than this in a physics step was recycled (placed elsewhere), m.
JUMP_M = 30.0
#: Fields of ``vehicles`` that a trajectory keeps, with their types.
_FIELDS = {
    **dict.fromkeys(("x", "y", "heading", "speed", "acceleration", "length", "width"), np.float64),
    "target_lane": np.int64,
    "valid": np.bool_,
}


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

    Frame 0 is the state after the reset. SI units: positions of the bodies' centres in m, ``x``
    along the road, ``y`` to the left; ``heading`` in rad, anticlockwise.
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
        """The ego's ``rms_acceleration`` and ``hardest_braking`` (0 or below), m/s2, and
        ``rms_jerk``, m/s3.
        """
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
            raise UserError(
                f"start at {start_s:g} s: the episode lasts {self.time_s[-1]:g} s; choose a part of it."
            )
        whole = replace(self, driven_jerk=self.jerk())
        frames = [
            each.name
            for each in fields(self)
            if each.name not in ("label", "outcome", "soft_crash_s")
        ]
        later: dict[str, Any] = {name: getattr(whole, name)[first:] for name in frames}
        return replace(whole, **later)

    def overlapping(self) -> BoolArray:
        """Whether a vehicle's box overlaps another's, [T, M]."""
        unused = dict.fromkeys(keys.VEHICLE_FIELDS, torch.zeros(self.x.shape, dtype=torch.float64))
        boxes = ("x", "y", "heading", "length", "width", "valid")
        used = {name: torch.as_tensor(getattr(self, name)) for name in boxes}
        return pair_overlaps(Vehicles(**(unused | used))).any(-1).numpy()


# Recording


@dataclass
class Recorder:
    """Collects frames of one row; the environment calls it after each physics step."""

    row: int = 0
    #: What a trajectory keeps of a frame, by its name there.
    frames: list[dict[str, Any]] = field(default_factory=list)
    #: Frames recorded by the end of each decision, and its reward; empty if rewards are not
    #: recorded.
    decisions: list[tuple[int, float]] = field(default_factory=list)
    #: Ends of the decisions with a soft crash, s.
    soft_crash_s: list[float] = field(default_factory=list)
    current_action: int = -1
    current_return: float = 0.0
    current_values: FloatArray = field(default_factory=lambda: np.empty(0))

    @property
    def time_s(self) -> float:
        """Time of the last frame, s."""
        return self.frames[-1]["time_s"]

    def __call__(self, vehicles: Vehicles, running: Tensor) -> None:
        """Hook of the environment.

        Vehicles [N, M] after a physics step, ``running`` [N] the rows that took it.
        """
        if bool(running[self.row]):
            self.add(vehicles.as_dict(), self.time_s + keys.PHYSICS_STEP_S)

    def add(self, vehicles: Mapping[str, Tensor] | TensorDictBase, time_s: float) -> None:
        """Append a frame."""
        frame: dict[str, Any] = {
            "time_s": time_s,
            "action": self.current_action,
            "returns": self.current_return,
        }
        for name, kind in _FIELDS.items():
            frame[name] = vehicles[name][self.row].detach().cpu().numpy().astype(kind)
        self.frames.append({**frame, "action_values": self.current_values})

    def trajectory(self, label: EpisodeLabel, outcome: str = "") -> Trajectory:
        """The frames so far; the last one shows the return after the last decision."""
        reward = np.full(len(self.frames) if self.decisions else 0, np.nan)
        begin = 1
        for end, paid in self.decisions:
            reward[begin:end], begin = paid, end
        arrays = {
            name: np.stack([frame[name] for frame in self.frames])
            for name in (*_FIELDS, "action", "returns")
        }
        arrays["returns"][-1] = self.current_return
        values = [frame["action_values"] for frame in self.frames]
        width = max(map(len, values))
        values = [each if len(each) else np.full(width, np.nan) for each in values]
        return Trajectory(
            label=label,
            time_s=np.array([frame["time_s"] for frame in self.frames]).round(6),
            **arrays,
            outcome=outcome,
            action_values=np.stack(values) if width else np.empty((0, 0)),
            reward=reward,
            soft_crash_s=np.array(self.soft_crash_s),
        )


def road_of_row(state: TensorDictBase, road: Road, row: int) -> tuple[int, float]:
    """Lanes and lane width, m, of a row.

    Of its replayed scene if ``state`` has one, else of ``road``.
    """
    found = road_in(state, road)
    lanes, width = (torch.as_tensor(value).flatten() for value in (found.lanes, found.lane_width_m))
    return int(lanes[min(row, len(lanes) - 1)]), float(width[min(row, len(width) - 1)])


def outcome_of(state: TensorDictBase, row: int = 0) -> str:
    """The event that ended the episode of a row; empty where none did."""
    events = state[keys.EVENTS]
    return next((name for name in keys.END_EVENTS if bool(events[name][row])), "")


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
    if not hasattr(base, "recorder"):
        raise UserError(
            f"env={type(base).__name__}: it cannot be recorded; expected a HighwayEnv of this process."
        )
    before, base.recorder = base.recorder, (recorder := Recorder())
    try:
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            state = env.reset(start_of(env, [episode], seed))
            label = EpisodeLabel(agent, traffic, seed, episode, *road_of_row(state, base.road, 0))
            recorder.add(state[keys.VEHICLES], 0.0)
            while not state["done"][0] and recorder.time_s < max_time_s - 1e-6:
                state = _decide(env, policy, policy(state), recorder)
    finally:
        base.recorder = before
    return recorder.trajectory(label, outcome_of(state))


def _decide(
    env: EnvBase, policy: TensorDictModuleBase, state: TensorDictBase, recorder: Recorder
) -> TensorDictBase:
    """One decision; the state after it."""
    recorder.current_action = int(state[keys.ACTION][0])
    # Action values [N, A]: from the policy's network, or its output; None if it has none.
    is_greedy = isinstance(policy, GreedyPolicy)
    values = (
        policy.network.values(state[keys.OBSERVATION])
        if is_greedy
        else state.get("action_value", None)
    )
    if values is not None and values.ndim == 2:
        recorder.current_values = values[0].double().cpu().numpy()
    stepped = env.step(state)
    reward = float(stepped["next", keys.REWARD][0])
    recorder.current_return += reward
    recorder.decisions.append((len(recorder.frames), reward))
    if int(stepped["next", keys.EVENTS, keys.SOFT_CRASH][0]) > 0:
        recorder.soft_crash_s.append(recorder.time_s)
    return env.step_mdp(stepped)


# Tracks


def write_tracks(
    trajectories: Sequence[Trajectory], path: str | Path, format: Literal["csv", "parquet"]
) -> Path:
    """Write episodes, a scene each, atomically, as a file that :func:`ganlane.data.read_scenes`
    reads back.

    Parquet holds the schema (:mod:`ganlane.data.schema`) itself. In CSV, the form of recordings
    from elsewhere, the speed is called ``v``, lanes are counted from the left, from 1, and ``y`` is
    0 at the centre of lane 1. It has no lane width, and a rightmost lane without vehicles is lost.

    Raises:
        UserError: there is no episode, or one whose frames are not 0.1 s apart.
    """
    if not trajectories:
        raise UserError(f"format={format}: no episode to write; record at least one.")
    labels = [each.label for each in trajectories]
    tables = [to_tracks(each, name) for each, name in zip(trajectories, scene_names(labels))]
    if format == "parquet":
        write_prepared(sort(pl.concat(tables)), path)
        return Path(path)
    for number, label in enumerate(labels):
        tables[number] = scene_csv(tables[number], pl.lit(label.lanes - 1), label.lane_width_m)
    with atomic_path(path) as part:
        pl.concat(tables).write_csv(part)
    return Path(path)


def to_tracks(trajectory: Trajectory, scene: str = "simulated") -> pl.DataFrame:
    """The trajectory as a table in the schema of recordings; a recycled vehicle begins a new track.

    Raises:
        UserError: the frames are not 0.1 s apart.
    """
    if len(trajectory) > 1 and abs(trajectory.frame_s - keys.PHYSICS_STEP_S) > 1e-6:
        raise UserError(
            f"trajectory: its frames are {trajectory.frame_s:g} s apart, tracks need {keys.PHYSICS_STEP_S} s; "
            "record it at every physics step."
        )
    frames, vehicles = trajectory.x.shape
    columns = {
        "vehicle": np.arange(vehicles) + TRACK_STRIDE * np.cumsum(trajectory.jumped(), axis=0),
        "frame": np.broadcast_to(np.arange(frames)[:, None], (frames, vehicles)),
        **{name: getattr(trajectory, name) for name in ("x", "y", "speed", "length", "width")},
        "lane": trajectory.lane(),
    }
    shown = trajectory.valid
    table = pl.DataFrame(
        {"scene": [scene] * int(shown.sum()), **{k: v[shown] for k, v in columns.items()}}
    )
    return table.select(pl.col(name).cast(kind) for name, kind in SCHEMA.items()).sort(
        "scene", "vehicle", "frame"
    )


def scene_names(labels: Sequence[EpisodeLabel]) -> list[str]:
    """A name for each episode's scene, ``AGENT_TRAFFIC_SEED_EPISODE``.

    A number follows where two would be alike.
    """
    names: list[str] = []
    for label in labels:
        name = f"{Path(label.agent).stem}_{label.traffic}_{label.seed}_{label.episode}"
        again = sum(other == name or other.startswith(f"{name}-") for other in names)
        names.append(f"{name}-{again + 1}" if again else name)
    return names
