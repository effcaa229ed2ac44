"""What gymnasium's render modes show: the frames of :mod:`ganlane.view`, drawn while episodes run."""

from __future__ import annotations

import time

import numpy as np
import numpy.typing as npt
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from ganlane import keys
from ganlane.gym.window import FilmWindow
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.state import road_in
from ganlane.view import DrawingParameters, EpisodeLabel, FramePainter, Recorder
from ganlane.view.frames import Picture

#: What is kept of the past, in physics steps: as much as the trails show.
_KEPT = round(DrawingParameters().trail_s / PHYSICS_STEP_S) + 1


def real_time_fps(env: TransformedEnv) -> int:
    """Frames per second at which a frame per decision shows real time, at least 1."""
    return max(1, round(1.0 / env.base_env.episode.decision_period_s))


def label_of(env: TransformedEnv, state: TensorDictBase, row: int, traffic: str) -> EpisodeLabel:
    """What the header of a row says."""
    road = road_in(state, env.base_env.road)
    lanes, width = (float(np.ravel(value)[min(row, np.size(value) - 1)]) for value in (road.lanes, road.lane_width_m))
    seed, episode = (int(state.get(name)[row]) for name in (keys.SEED, keys.EPISODE))
    return EpisodeLabel("ego", traffic, seed, episode, int(lanes), width)


def outcome_of(state: TensorDictBase, row: int) -> str:
    """The event that ended the episode of a row; empty where none did."""
    events = state.get(keys.EVENTS)
    return next((name for name in keys.END_EVENTS if bool(events.get(name)[row])), "")


class LiveView:
    """Follows the one row of an environment, physics step by physics step.

    Args:
        env: the environment; its recorder is taken.
        traffic: name for the header.
        window: shows every physics step at the pace of the simulation; None: pictures are asked for.
    """

    def __init__(self, env: TransformedEnv, traffic: str, window: FilmWindow | None = None) -> None:
        self.env, self.traffic, self.window = env, traffic, window
        self._recorder, self._label, self._outcome = Recorder(), EpisodeLabel(), ""
        #: Moments recorded before the decision under way.
        self._before = 0

    def start(self, state: TensorDictBase) -> None:
        """A new episode begins at ``state``."""
        self._recorder, self._outcome = Recorder(), ""
        self._label = label_of(self.env, state, 0, self.traffic)
        self._recorder.add(state.get(keys.VEHICLES), 0.0)
        self.env.base_env.recorder = self._recorder
        self._show(1)

    def decide(self, action: int) -> None:
        """An action is about to be carried out."""
        self._recorder.current_action = action
        self._forget()
        self._before = len(self._recorder.frames)

    def decided(self, after: TensorDictBase, reward: float) -> None:
        """It was."""
        self._recorder.current_return += reward
        self._outcome = outcome_of(after, 0)
        self._show(len(self._recorder.frames) - self._before)

    def picture(self) -> Picture:
        """The last moment."""
        painter = self._painter()
        return painter.draw(len(painter.trajectory) - 1)

    def close(self) -> None:
        """Close the window."""
        if self.window is not None:
            self.window.close()

    def _painter(self) -> FramePainter:
        return FramePainter(self._recorder.trajectory(self._label, self._outcome))

    def _forget(self) -> None:
        """Keep no more of the past than the trails show."""
        record = self._recorder
        for kept in (record.frames, record.time_s, record.action, record.returns, record.action_values):
            del kept[:-_KEPT]

    def _show(self, frames: int) -> None:
        """The last ``frames`` moments in the window, one every physics step of real time."""
        if self.window is None:
            return
        painter = self._painter()
        count = len(painter.trajectory)
        for frame in range(max(0, count - frames), count):
            due = time.monotonic() + PHYSICS_STEP_S
            self.window.show(painter.draw(frame))
            self.window.wait(max(0.0, due - time.monotonic()))


class BatchView:
    """Draws every row of a batch as it stands, without trails.

    Args:
        env: the environment.
        traffic: name for the header.
    """

    def __init__(self, env: TransformedEnv, traffic: str) -> None:
        self.env, self.traffic = env, traffic
        self._returns: npt.NDArray[np.float64] = np.zeros(env.batch_size[0])
        self._actions: npt.NDArray[np.int64] = np.full(env.batch_size[0], -1)

    def start(self, rows: npt.NDArray[np.bool_]) -> None:
        """New episodes begin in ``rows`` [N]."""
        self._returns[rows], self._actions[rows] = 0.0, -1

    def decided(self, actions: npt.ArrayLike, reward: npt.NDArray[np.float64]) -> None:
        """A decision was made in every row."""
        self._returns += reward
        self._actions[:] = actions

    def pictures(self, state: TensorDictBase) -> tuple[Picture, ...]:
        """The rows of ``state``."""
        return tuple(self._picture(state, row) for row in range(len(self._returns)))

    def _picture(self, state: TensorDictBase, row: int) -> Picture:
        recorder = Recorder(row, current_action=int(self._actions[row]), current_return=float(self._returns[row]))
        recorder.add(state.get(keys.VEHICLES), 0.0)
        recorder.time_s[0] = float(state.get(keys.STEP)[row]) * PHYSICS_STEP_S
        return FramePainter(recorder.trajectory(label_of(self.env, state, row, self.traffic))).draw(0)
