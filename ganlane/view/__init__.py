"""Seeing an episode: recorded once, then drawn, filmed or exported, all without a display.

:func:`record_episode` gives a :class:`Trajectory`. :class:`FramePainter` draws its frames,
:class:`Film` chooses them by time, :func:`write_film` writes mp4, GIF or a PNG strip,
:func:`write_player` an HTML page that plays several episodes side by side, :func:`write_tracks` a
file in the form of recorded traffic.

Charts are in :mod:`ganlane.view.figures` (learning curves, recordings), which alone loads
matplotlib.
"""

from ganlane.view.canvas import WindowParameters
from ganlane.view.film import Film, film_strip, write_film
from ganlane.view.frames import DrawingParameters, FramePainter
from ganlane.view.player import player_page, write_player
from ganlane.view.record import (
    EpisodeLabel,
    Recorder,
    Trajectory,
    record_episode,
    to_tracks,
    write_tracks,
)

__all__ = [
    "DrawingParameters",
    "EpisodeLabel",
    "Film",
    "FramePainter",
    "Recorder",
    "Trajectory",
    "WindowParameters",
    "film_strip",
    "player_page",
    "record_episode",
    "to_tracks",
    "write_film",
    "write_player",
    "write_tracks",
]
