"""The player's page: its template filled in, nothing in it that could run but the package's own scripts."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from ganlane.errors import UserError
from ganlane.files import write_bytes
from ganlane.view.player.encoding import UNITS, episode_data
from ganlane.view.trajectory import Trajectory

#: Joined in this order.
_SCRIPTS = ("episode.js", "road.js", "chart.js", "panel.js", "player.js")
#: Three episodes stay under 2 MB.
MAX_BYTES_PER_EPISODE = 660_000
#: Frames from one sample to the next; the first that fits is taken.
_STRIDES = (1, 2, 3, 5, 10)


def player_page(trajectories: Sequence[Trajectory], max_bytes: int | None = None) -> str:
    """A whole HTML page that plays ``trajectories`` side by side.

    Where the page is larger than ``max_bytes`` (None: 660 kB an episode), samples are taken 0.2, 0.3, 0.5 or 1 s
    apart instead of 0.1 s; the player interpolates.

    Raises:
        UserError: there is no episode, or the page is too large even so.
    """
    if not trajectories:
        raise UserError("format=html: no episode to play; record at least one.")
    limit = max_bytes or MAX_BYTES_PER_EPISODE * len(trajectories)
    size = 0
    for stride in _STRIDES:
        data = {"units": UNITS, "episodes": [episode_data(each, stride) for each in trajectories]}
        page = _fill(_title(trajectories), data)
        size = len(page.encode())
        if size <= limit:
            return page
    raise UserError(
        f"format=html: the page takes {size} bytes, {limit} are allowed; choose fewer episodes, an earlier "
        "film.end_s or a larger film.max_bytes."
    )


def write_player(trajectories: Sequence[Trajectory], path: str | Path, max_bytes: int | None = None) -> Path:
    """Write :func:`player_page` to ``path``, atomically, and return it."""
    write_bytes(path, player_page(trajectories, max_bytes).encode())
    return Path(path)


def _title(trajectories: Sequence[Trajectory]) -> str:
    """Who drives on what, each once."""
    pairs = dict.fromkeys(f"{each.label.agent} on {each.label.traffic}" for each in trajectories)
    return ", ".join(pairs)


def _fill(title: str, data: dict[str, Any]) -> str:
    """The template with its parts, put in at one go: what stands in a part is no place to fill."""
    style = _text("style.css")
    script = "(() => {\n'use strict';\n" + "\n".join(_text(name) for name in _SCRIPTS) + "})();\n"
    parts = {
        "title": html.escape(title),
        "policy": f"default-src 'none'; img-src data:; style-src {_hash(style)}; script-src {_hash(script)}",
        "style": style,
        "script": script,
        "data": script_safe_json(data),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], _text("page.html"))


def script_safe_json(data: Any) -> str:
    """JSON that neither ends nor comments out the script element it stands in."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _hash(text: str) -> str:
    """How the page's policy names a script or style that may be used."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _text(name: str) -> str:
    return (files("ganlane.view.player") / name).read_text(encoding="utf-8")
