"""The window of ``render_mode=human``."""

from __future__ import annotations

import importlib.util
import os
import sys
import time
from typing import Any

import numpy as np
import numpy.typing as npt

from ganlane.errors import UserError


def has_display() -> bool:
    """Whether a window can be opened.

    Pygame is installed and, except on Windows and macOS, a display is set.
    """
    # Only searched for: importing pygame takes time and prints a greeting.
    if importlib.util.find_spec("pygame") is None:
        return False
    # X11, Wayland, or SDL's drivers without either.
    variables = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    return sys.platform in ("win32", "darwin") or any(map(os.environ.get, variables))


class FilmWindow:
    """A pygame window that shows pictures until the user closes it.

    Raises:
        UserError: pygame is missing, or there is no display.
    """

    def __init__(self) -> None:
        if not has_display():
            raise UserError(
                "render_mode=human: needs pygame (pip install 'ganlane[human]') and a display, and "
                "one of them is missing here; use render_mode=rgb_array, or ganlane render for a "
                "film."
            )
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        import pygame  # an extra

        #: None once the window is closed.
        self._pygame: Any = pygame
        self._screen: Any = None
        try:
            pygame.display.init()
        except pygame.error as error:
            raise UserError(
                f"render_mode=human: no window can be opened ({error}); use render_mode=rgb_array."
            ) from error
        pygame.display.set_caption("ganlane")

    def show(self, picture: npt.NDArray[np.uint8]) -> None:
        """Put a picture [height, width, 3] uint8 into the window."""
        pygame = self._pygame
        if pygame is None:
            return
        # Arrays have rows first, pygame has the width first.
        size = picture.shape[1::-1]
        try:
            # Opened with the first picture, whose size is known only then.
            if self._screen is None:
                self._screen = pygame.display.set_mode(size)
            self._screen.blit(pygame.image.frombuffer(picture.tobytes(), size, "RGB"), (0, 0))
            pygame.display.flip()
            # Without taking events the desktop takes the window for hung.
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
        if self._pygame is not None:
            self._pygame.display.quit()
        self._pygame = self._screen = None
