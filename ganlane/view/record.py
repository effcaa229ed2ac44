"""Recording an episode while it runs, at every physics step."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ganlane import keys
from ganlane.agents.policy import GreedyPolicy
from ganlane.errors import UserError
from ganlane.evaluation.episodes import start_of
from ganlane.sim.state import Road, Vehicles, road_in
from ganlane.view.trajectory import EpisodeLabel, Trajectory

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
