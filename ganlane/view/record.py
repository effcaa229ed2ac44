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
from ganlane.sim.state import Vehicles, road_in
from ganlane.view.trajectory import EpisodeLabel, Trajectory

#: Fields of ``vehicles`` that a trajectory keeps, with their types.
_FIELDS = {
    **dict.fromkeys(("x", "y", "heading", "speed", "acceleration", "length", "width"), np.float64),
    "target_lane": np.int64,
    "valid": np.bool_,
}


@dataclass
class Recorder:
    """Collects frames of one row; it is also the hook that the environment calls after a physics step."""

    row: int = 0
    frames: list[dict[str, np.ndarray]] = field(default_factory=list)
    time_s: list[float] = field(default_factory=list)
    action: list[int] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    action_values: list[np.ndarray] = field(default_factory=list)
    #: Frames recorded by the end of each decision, and its reward; empty where nobody tells them.
    decided: list[tuple[int, float]] = field(default_factory=list)
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

    def trajectory(self, label: EpisodeLabel, outcome: str = "") -> Trajectory:
        """The frames so far; the last one shows the return after the last decision."""
        fields = {name: np.stack([frame[name] for frame in self.frames]) for name in _FIELDS}
        return Trajectory(
            label=label,
            time_s=np.array(self.time_s).round(6),
            **fields,
            action=np.array(self.action),
            returns=np.array([*self.returns[:-1], self.current_return]),
            outcome=outcome,
            action_values=self._values(),
            reward=self._rewards(),
        )

    def _rewards(self) -> np.ndarray:
        """Reward of each frame's decision, [T]; not a number before the first; empty where rewards were not told."""
        rewards = np.full(len(self.frames) if self.decided else 0, np.nan)
        begin = 1
        for end, reward in self.decided:
            rewards[begin:end], begin = reward, end
        return rewards

    def _values(self) -> np.ndarray:
        """Action values [T, A]; not a number before the first decision; empty where the policy tells none."""
        width = max(len(values) for values in self.action_values)
        unknown = np.full(width, np.nan)
        rows = [values if len(values) else unknown for values in self.action_values]
        return np.stack(rows) if width else np.empty((0, 0))


def innermost(env: Any) -> Any:
    """The environment itself, below its transforms."""
    while hasattr(env, "base_env"):
        env = env.base_env
    return env


@contextmanager
def _listening(env: EnvBase, recorder: Recorder) -> Iterator[None]:
    """Hang the recorder into the environment for a while."""
    base = innermost(env)
    if not hasattr(base, "recorder"):
        raise UserError(f"env={type(base).__name__}: it cannot be recorded; expected a HighwayEnv of this process.")
    before, base.recorder = base.recorder, recorder
    try:
        yield
    finally:
        base.recorder = before


def _label(env: EnvBase, state: TensorDictBase, agent: str, traffic: str, seed: int, episode: int) -> EpisodeLabel:
    """The label of row 0, with its road: a replayed scene's stands in ``state``, else it is the environment's."""
    road = road_in(state, innermost(env).road)
    lanes, width = (torch.as_tensor(value).flatten()[0].item() for value in (road.lanes, road.lane_width_m))
    return EpisodeLabel(agent, traffic, seed, episode, int(lanes), float(width))


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
    recorder = Recorder()
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC), _listening(env, recorder):
        state = env.reset(start_of(env, [episode], seed))
        label = _label(env, state, agent, traffic, seed, episode)
        recorder.add(state[keys.VEHICLES], 0.0)
        outcome, done = "", False
        while not done and recorder.time_s[-1] < max_time_s - 1e-6:
            state = _decide(env, policy, policy(state), recorder)
            done = bool(state["done"][0])
            outcome = _outcome(state) if done else ""
    return recorder.trajectory(label, outcome)


def _decide(env: EnvBase, policy: TensorDictModuleBase, state: TensorDictBase, recorder: Recorder) -> TensorDictBase:
    """One decision; the state after it."""
    recorder.current_action = int(state[keys.ACTION][0])
    values = _action_values(policy, state)
    if values is not None and values.ndim == 2:
        recorder.current_values = values[0].double().cpu().numpy()
    stepped = env.step(state)
    reward = float(stepped["next", keys.REWARD][0])
    recorder.current_return += reward
    recorder.decided.append((len(recorder.frames), reward))
    return env.step_mdp(stepped)


def _action_values(policy: TensorDictModuleBase, state: TensorDictBase) -> Tensor | None:
    """What the policy expects of each action, [N, A]: from its output, or from its network; None if it tells none."""
    if isinstance(policy, GreedyPolicy):
        return policy.network.values(state[keys.OBSERVATION])
    return state.get("action_value", None)


def _outcome(after: TensorDictBase) -> str:
    """The end event of row 0; empty where something else ended it."""
    events = after[keys.EVENTS]
    return next((name for name in keys.END_EVENTS if bool(events[name][0])), "")
