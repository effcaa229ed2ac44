"""One self-contained HTML page that plays episodes: road, action values, reward, the ego's comfort.

:func:`write_player` fills ``page.html`` with ``style.css``, the scripts beside it and the episodes as JSON
(:mod:`ganlane.view.player.encoding`). The page loads nothing and runs nothing but these scripts.
"""

from ganlane.view.player.page import player_page, write_player

__all__ = ["player_page", "write_player"]
