"""A window for ``render_mode="human"``, by tkinter and Pillow alone."""

from __future__ import annotations

import importlib.util
import os
import sys
import time
from typing import Any

from PIL import Image

from ganlane.errors import UserError
from ganlane.view.frames import Picture


def has_display() -> bool:
    """Whether a window can be opened here: tkinter is there and, but on Windows and macOS, a display is named."""
    if importlib.util.find_spec("tkinter") is None:
        return False
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY"))


class FilmWindow:
    """Shows pictures one after the other. Once its user has closed it, it shows nothing more.

    Raises:
        UserError: there is no display, or tkinter is missing.
    """

    def __init__(self, title: str) -> None:
        if not has_display():
            raise UserError(
                "render_mode=human: needs tkinter and a display, and one of them is missing here; use "
                "render_mode=rgb_array, or ganlane render for a film."
            )
        self._root: Any = _open(title)
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
        """Let so much time pass, if the window is open."""
        if self._root is not None:
            time.sleep(seconds)

    def close(self) -> None:
        """Close the window; again does no harm."""
        root, self._root = self._root, None
        if root is not None:
            root.destroy()


def _open(title: str) -> Any:
    """A new window.

    Raises:
        UserError: the display that is named cannot be reached.
    """
    import tkinter

    try:
        root = tkinter.Tk()
    except tkinter.TclError as error:
        raise UserError(
            f"render_mode=human: no window can be opened ({error}); use render_mode=rgb_array."
        ) from error
    root.title(title)
    return root
