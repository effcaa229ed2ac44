"""Gymnasium's render modes: frames of :mod:`ganlane.view`, drawn while episodes run, and a window that shows them."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from ganlane import keys
from ganlane.errors import UserError
from ganlane.gym import has_display
from ganlane.keys import PHYSICS_STEP_S
from ganlane.view import DrawingParameters, EpisodeLabel, FramePainter, Recorder
from ganlane.view.frames import Picture
from ganlane.view.record import outcome_of, road_of_row

#: Recorded physics steps that are kept: as many as the trails show.
_KEPT = round(DrawingParameters().trail_s / PHYSICS_STEP_S) + 1


def _label(env: TransformedEnv, state: TensorDictBase, row: int, traffic: str) -> EpisodeLabel:
    """The header's text for a row."""
    seed, episode = (int(state.get(name)[row]) for name in (keys.SEED, keys.EPISODE))
    return EpisodeLabel("ego", traffic, seed, episode, *road_of_row(state, env.base_env.road, row))


class LiveView:
    """Records every physics step of an environment of one row.

    Args:
        env: the environment; its recorder is replaced.
        traffic: name for the header.
        window: shows every physics step in real time; None: pictures on request.
    """

    def __init__(self, env: TransformedEnv, traffic: str, window: FilmWindow | None = None) -> None:
        self.env, self.traffic, self.window = env, traffic, window

    def start(self, state: TensorDictBase) -> None:
        """A new episode begins at ``state``."""
        self._recorder, self._outcome = Recorder(), ""
        #: Frames recorded before the present decision.
        self._before = 0
        self._label = _label(self.env, state, 0, self.traffic)
        self._recorder.add(state.get(keys.VEHICLES), 0.0)
        self.env.base_env.recorder = self._recorder
        self._show()

    def before_step(self, action: int) -> None:
        """Record the action of the next step."""
        self._recorder.current_action = action
        self._recorder.keep_last(_KEPT)
        self._before = len(self._recorder.frames)

    def after_step(self, after: TensorDictBase, reward: float) -> None:
        """Record the outcome of the step, and show its frames."""
        self._recorder.current_return += reward
        self._outcome = outcome_of(after)
        self._show()

    def picture(self) -> Picture:
        """The last frame, [height, width, 3]."""
        return self._painter().draw(len(self._recorder.frames) - 1)

    def pictures(self) -> Iterator[Picture]:
        """The frames of the last decision, ten per second; after a reset, the only one."""
        painter = self._painter()
        return map(painter.draw, range(self._before, len(self._recorder.frames)))

    def close(self) -> None:
        """Close the window."""
        if self.window is not None:
            self.window.close()

    def _painter(self) -> FramePainter:
        return FramePainter(self._recorder.trajectory(self._label, self._outcome))

    def _show(self) -> None:
        """Show the frames of the last decision in the window, in real time."""
        if self.window is None:
            return
        due = time.monotonic() + PHYSICS_STEP_S
        for picture in self.pictures():
            self.window.show(picture)
            self.window.wait(max(0.0, due - time.monotonic()))
            due = time.monotonic() + PHYSICS_STEP_S


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
    """A pygame window that shows pictures until the user closes it.

    Raises:
        UserError: pygame is missing, or there is no display.
    """

    def __init__(self, title: str) -> None:
        if not has_display():
            raise UserError(
                "render_mode=human: needs pygame (pip install 'ganlane[human]') and a display, and one of them is "
                "missing here; use render_mode=rgb_array, or ganlane render for a film."
            )
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        import pygame  # an extra

        self._pygame: Any = pygame
        self._screen: Any = None
        try:
            pygame.display.init()
        except pygame.error as error:
            raise UserError(
                f"render_mode=human: no window can be opened ({error}); use render_mode=rgb_array."
            ) from error
        pygame.display.set_caption(title)

    def show(self, picture: Picture) -> None:
        """Put a picture [height, width, 3] uint8 into the window."""
        pygame = self._pygame
        if pygame is None:
            return
        size = picture.shape[1::-1]
        try:
            if self._screen is None:
                self._screen = pygame.display.set_mode(size)
            self._screen.blit(pygame.image.frombuffer(picture.tobytes(), size, "RGB"), (0, 0))
            pygame.display.flip()
            if pygame.event.get(pygame.QUIT):
                self.close()
            pygame.event.pump()
        except pygame.error:  # closed by other code: pygame has one window per process
            self._pygame = None

    def wait(self, seconds: float) -> None:
        """Wait, if the window is open."""
        if self._pygame is not None:
            time.sleep(seconds)

    def close(self) -> None:
        """Close the window; may be called again."""
        pygame, self._pygame, self._screen = self._pygame, None, None
        if pygame is not None:
            pygame.display.quit()
