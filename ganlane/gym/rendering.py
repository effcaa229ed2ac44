"""Gymnasium's render modes: frames of :mod:`ganlane.view`, drawn while episodes run.

:class:`LiveView` is that of the single environment, every physics step with trails;
:class:`BatchView` that of a batch, the present state of every row.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from ganlane import keys
from ganlane.gym.rows import Flags
from ganlane.gym.tensor_rows import TensorRows
from ganlane.gym.window import FilmWindow
from ganlane.keys import PHYSICS_STEP_S
from ganlane.settings.render import FilmConfig
from ganlane.view import EpisodeLabel, FramePainter, Recorder
from ganlane.view.frames import Picture
from ganlane.view.record import outcome_of

#: Recorded physics steps that are kept: as many as the trails show.
_TRAIL_STEPS = round(FilmConfig.trail_s / PHYSICS_STEP_S) + 1


def _label(rows: TensorRows, row: int) -> EpisodeLabel:
    """The header's text for a row."""
    road = rows.env.base_env.road
    traffic = rows.config.traffic.label()
    return EpisodeLabel.of(rows.now(), road, "ego", traffic, row)


class LiveView:
    """Records every physics step of one row.

    Nothing but :meth:`close` may be called before the first :meth:`start`.

    Args:
        rows: the row; the recorder of its environment is replaced.
        window: shows every physics step in real time; None: pictures on request.
    """

    def __init__(self, rows: TensorRows, window: FilmWindow | None = None) -> None:
        self.rows = rows
        self.window = window

    def start(self) -> None:
        """A new episode has begun."""
        self._recorder = Recorder()
        self._outcome = ""
        #: Frames recorded before the present decision.
        self._before = 0
        self._label = _label(self.rows, 0)

        # The scene before anything moves; from here on the environment adds a frame per physics
        # step.
        vehicles = self.rows.now().get(keys.VEHICLES)
        self._recorder.add(vehicles, 0.0)
        self.rows.env.base_env.recorder = self._recorder

        self._show()

    def before_step(self, action: int) -> None:
        """Record the action of the next step, -1: none that has a number."""
        self._recorder.current_action = action

        # An episode may last for hours: what the trails no longer show is dropped.
        del self._recorder.frames[:-_TRAIL_STEPS]
        self._before = len(self._recorder.frames)

    def after_step(self, reward: float) -> None:
        """Record the outcome of the step, and show its frames."""
        # The reward is known only now: of the decision's frames the last one alone shows it.
        self._recorder.current_return += reward
        self._outcome = outcome_of(self.rows.now())
        self._show()

    def picture(self) -> Picture:
        """The last frame, [height, width, 3]."""
        # Drawn only when asked for: the painter is made anew from what was recorded so far.
        last = len(self._recorder.frames) - 1
        return self._painter().draw(last)

    def pictures(self) -> Iterator[Picture]:
        """The frames of the last decision, ten per second; after a reset, the only one."""
        frames = range(self._before, len(self._recorder.frames))
        return map(self._painter().draw, frames)

    def close(self) -> None:
        """Close the window."""
        if self.window is not None:
            self.window.close()

    def _painter(self) -> FramePainter:
        """Draws what was recorded so far."""
        trajectory = self._recorder.trajectory(self._label, self._outcome)
        return FramePainter(trajectory)

    def _show(self) -> None:
        """Show the frames of the last decision in the window, in real time."""
        if self.window is None:
            return

        # Drawing takes time of its own, which is taken off the wait.
        due_s = time.monotonic() + PHYSICS_STEP_S
        for picture in self.pictures():
            self.window.show(picture)

            left_s = due_s - time.monotonic()
            self.window.wait(max(0.0, left_s))

            # Not due_s + PHYSICS_STEP_S: a slow frame must not make the next ones hurry.
            due_s = time.monotonic() + PHYSICS_STEP_S


class BatchView:
    """Draws the present state of every row, without trails.

    Args:
        rows: to be drawn; their state is read when pictures are asked for.
    """

    def __init__(self, rows: TensorRows) -> None:
        self.rows = rows
        # Return and last action are all that is kept: without trails no past state is needed. An
        # action of -1 is shown as none.
        self._returns = np.zeros(rows.count)
        self._actions = np.full(rows.count, -1)

    def start(self, fresh: Flags) -> None:
        """New episodes begin in the rows where ``fresh`` [N] is true."""
        self._returns[fresh] = 0.0
        self._actions[fresh] = -1

    def after_step(self, actions: npt.ArrayLike, reward: npt.NDArray[np.float64]) -> None:
        """Record actions and rewards [N] of a step."""
        self._returns += reward
        self._actions[:] = actions

    def pictures(self) -> tuple[Picture, ...]:
        """One of every row."""
        return tuple(map(self._picture, range(self.rows.count)))

    def _picture(self, row: int) -> Picture:
        """The last frame of a row, [height, width, 3]."""
        state = self.rows.now()
        recorder = Recorder(
            row,
            current_action=int(self._actions[row]),
            current_return=float(self._returns[row]),
        )

        # A film of one frame.
        time_s = float(state.get(keys.STEP)[row]) * PHYSICS_STEP_S
        recorder.add(state.get(keys.VEHICLES), time_s)

        label = _label(self.rows, row)
        trajectory = recorder.trajectory(label)
        return FramePainter(trajectory).draw(0)
