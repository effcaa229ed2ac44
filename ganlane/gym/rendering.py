"""Gymnasium's render modes: frames of :mod:`ganlane.view`, drawn while episodes run, and a window for them."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from ganlane import keys
from ganlane.errors import UserError
from ganlane.gym import has_display
from ganlane.keys import PHYSICS_STEP_S
from ganlane.view import DrawingParameters, EpisodeLabel, FramePainter, Recorder
from ganlane.view.frames import Picture
from ganlane.view.record import outcome_of, road_of_row

#: Physics steps of the past that are kept: as many as the trails show.
_KEPT = round(DrawingParameters().trail_s / PHYSICS_STEP_S) + 1


def _label(env: TransformedEnv, state: TensorDictBase, row: int, traffic: str) -> EpisodeLabel:
    """The header's text for a row."""
    seed, episode = (int(state.get(name)[row]) for name in (keys.SEED, keys.EPISODE))
    return EpisodeLabel("ego", traffic, seed, episode, *road_of_row(state, env.base_env.road, row))


class LiveView:
    """Records the one row of an environment, physics step by physics step.

    Args:
        env: the environment; its recorder is taken.
        traffic: name for the header.
        window: shows every physics step at the pace of the simulation; None: pictures on request.
    """

    def __init__(self, env: TransformedEnv, traffic: str, window: FilmWindow | None = None) -> None:
        self.env, self.traffic, self.window = env, traffic, window
        self._recorder, self._label, self._outcome = Recorder(), EpisodeLabel(), ""
        #: Frames recorded before the decision under way.
        self._before = 0

    def start(self, state: TensorDictBase) -> None:
        """A new episode begins at ``state``."""
        self._recorder, self._outcome = Recorder(), ""
        self._label = _label(self.env, state, 0, self.traffic)
        self._recorder.add(state.get(keys.VEHICLES), 0.0)
        self.env.base_env.recorder = self._recorder
        self._show(1)

    def before_step(self, action: int) -> None:
        """Record the action of the next step."""
        self._recorder.current_action = action
        self._recorder.keep_last(_KEPT)
        self._before = len(self._recorder.frames)

    def after_step(self, after: TensorDictBase, reward: float) -> None:
        """Record the outcome of the step, and show its frames."""
        self._recorder.current_return += reward
        self._outcome = outcome_of(after)
        self._show(len(self._recorder.frames) - self._before)

    def picture(self) -> Picture:
        """The last frame, [height, width, 3]."""
        return self._painter().draw(len(self._recorder.frames) - 1)

    def close(self) -> None:
        """Close the window."""
        if self.window is not None:
            self.window.close()

    def _painter(self) -> FramePainter:
        return FramePainter(self._recorder.trajectory(self._label, self._outcome))

    def _show(self, frames: int) -> None:
        """The last ``frames`` frames in the window, one every physics step of real time."""
        if self.window is None:
            return
        painter, count = self._painter(), len(self._recorder.frames)
        for frame in range(max(0, count - frames), count):
            due = time.monotonic() + PHYSICS_STEP_S
            self.window.show(painter.draw(frame))
            self.window.wait(max(0.0, due - time.monotonic()))


class BatchView:
    """Draws the present state of every row of a batch, without trails.

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

    def after_step(self, actions: npt.ArrayLike, reward: npt.NDArray[np.float64]) -> None:
        """Record actions and rewards [N] of a step."""
        self._returns += reward
        self._actions[:] = actions

    def pictures(self, state: TensorDictBase) -> tuple[Picture, ...]:
        """The rows of ``state``."""
        return tuple(self._picture(state, row) for row in range(len(self._returns)))

    def _picture(self, state: TensorDictBase, row: int) -> Picture:
        recorder = Recorder(row, current_action=int(self._actions[row]), current_return=float(self._returns[row]))
        recorder.add(state.get(keys.VEHICLES), 0.0)
        recorder.time_s[0] = float(state.get(keys.STEP)[row]) * PHYSICS_STEP_S
        return FramePainter(recorder.trajectory(_label(self.env, state, row, self.traffic))).draw(0)


class FilmWindow:
    """A window by tkinter and Pillow that shows one picture after the other until its user closes it.

    Raises:
        UserError: there is no display, it cannot be reached, or tkinter is missing.
    """

    def __init__(self, title: str) -> None:
        if not has_display():
            raise UserError(
                "render_mode=human: needs tkinter and a display, and one of them is missing here; use "
                "render_mode=rgb_array, or ganlane render for a film."
            )
        import tkinter  # not part of every Python

        try:
            self._root: Any = tkinter.Tk()
        except tkinter.TclError as error:
            raise UserError(
                f"render_mode=human: no window can be opened ({error}); use render_mode=rgb_array."
            ) from error
        self._root.title(title)
        self._label: Any = None

    def show(self, picture: Picture) -> None:
        """Put a picture [height, width, 3] uint8 into the window."""
        if self._root is None:
            return
        import tkinter

        from PIL import ImageTk

        try:
            photo = ImageTk.PhotoImage(Image.fromarray(picture), master=self._root)
            if self._label is None:
                self._label = tkinter.Label(self._root, borderwidth=0)
                self._label.pack()
            self._label.configure(image=photo)
            self._label.image = photo  # tkinter keeps no reference of its own
            self._root.update()
        except tkinter.TclError:
            self._root = None

    def wait(self, seconds: float) -> None:
        """Wait, if the window is open."""
        if self._root is not None:
            time.sleep(seconds)

    def close(self) -> None:
        """Close the window; again does no harm."""
        root, self._root = self._root, None
        if root is not None:
            root.destroy()
