"""Seeing an episode: recorded once, then drawn, filmed or exported, all without a display.

:func:`record_episode` drives an episode and keeps a :class:`Trajectory`, frame by frame; :class:`FramePainter`
draws its frames; :class:`Film` chooses them by time, and :func:`write_film` writes mp4, GIF or a PNG strip.
:func:`write_player` writes one HTML page that plays several episodes beside each other. :func:`to_tracks` gives an
episode in the form of recorded traffic, :func:`write_tracks` writes it as CSV or Parquet.

Charts are in :mod:`ganlane.view.figures` (learning curves, recordings), which alone loads matplotlib.
"""

from ganlane.view.films import Film, film_strip, write_film
from ganlane.view.frames import DrawingParameters, FramePainter
from ganlane.view.player import player_page, write_player
from ganlane.view.record import Recorder, record_episode
from ganlane.view.runs import read_metrics, read_run, read_runs
from ganlane.view.tracks import write_tracks
from ganlane.view.trajectory import EpisodeLabel, Trajectory, to_tracks
from ganlane.view.window import WindowParameters

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
    "read_metrics",
    "read_run",
    "read_runs",
    "record_episode",
    "to_tracks",
    "write_film",
    "write_player",
    "write_tracks",
]
