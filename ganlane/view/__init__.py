# ruff: noqa: F401  (the names that users import from here)
"""Seeing an episode: recorded once, then drawn, filmed or exported, all without a display.

:func:`record_episode` gives a :class:`Trajectory`. :class:`FramePainter` draws its frames,
:func:`write_film` writes mp4, GIF or a PNG strip, :func:`write_player` an HTML page that plays
several episodes side by side, :func:`write_tracks` a file in the form of recorded traffic. How all
of them look is a :class:`ganlane.settings.render.FilmConfig`.

Charts are made with matplotlib, in the style of :mod:`ganlane.view.figures`:
:mod:`ganlane.view.curves` draws learning curves.
"""

from ganlane.view.film import write_film
from ganlane.view.frames import FramePainter
from ganlane.view.player import player_page, write_player
from ganlane.view.record import EpisodeLabel, Recorder, Trajectory, record_episode
from ganlane.view.tracks import to_tracks, write_tracks
