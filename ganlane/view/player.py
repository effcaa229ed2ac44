"""One self-contained HTML page that plays episodes: road, action values, reward, the ego's comfort.

The page is ``player_page/page.html`` with its style and scripts and the episodes as JSON. It loads
nothing and runs nothing but these scripts.

Numbers are whole multiples of small units. A *series* [T] is a list of T whole numbers: the first
sample, then each sample's difference from the one before. *Steps* are values that change now and
then: a flat list ``[sample, value, sample, value, ...]`` of the changes.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Sequence
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ganlane.errors import UserError
from ganlane.files import write_bytes
from ganlane.view.record import ACTION_NAMES, Trajectory

#: Three episodes stay under 2 MB.
MAX_BYTES_PER_EPISODE = 660_000
#: Units of series: s, m, m, rad, m/s, m/s2, m/s3.
UNITS = dict(time=0.01, x=0.01, y=0.01, heading=0.001, speed=0.01, acceleration=0.01, jerk=0.1)


def write_player(
    trajectories: Sequence[Trajectory], path: str | Path, max_bytes: int | None = None
) -> Path:
    """Write :func:`player_page` to ``path``, atomically, and return it."""
    write_bytes(path, player_page(trajectories, max_bytes).encode())
    return Path(path)


def player_page(trajectories: Sequence[Trajectory], max_bytes: int | None = None) -> str:
    """A whole HTML page that plays ``trajectories`` side by side.

    Where the page is larger than ``max_bytes`` (None: 660 kB an episode), samples are taken 0.2,
    0.3, 0.5 or 1 s apart instead of 0.1 s; the player interpolates.

    Raises:
        UserError: there is no episode, or the page is too large even so.
    """
    if not trajectories:
        raise UserError("format=html: no episode to play; record at least one.")
    limit = max_bytes or MAX_BYTES_PER_EPISODE * len(trajectories)
    title = ", ".join(
        dict.fromkeys(f"{each.label.agent} on {each.label.traffic}" for each in trajectories)
    )
    for stride in (1, 2, 3, 5, 10):
        page = _fill(
            title,
            {"units": UNITS, "episodes": [episode_data(each, stride) for each in trajectories]},
        )
        size = len(page.encode())
        if size <= limit:
            return page
    raise UserError(
        f"format=html: the page takes {size} bytes, {limit} are allowed; choose fewer episodes, an earlier "
        "film.end_s or a larger film.max_bytes."
    )


def _fill(title: str, data: dict[str, Any]) -> str:
    """The template with its parts, all put in at once: braces within a part are not replaced."""
    folder = files("ganlane.view") / "player_page"

    def text(name: str) -> str:
        return (folder / name).read_text(encoding="utf-8")

    style = text("style.css")
    # in this order
    scripts = ("episode.js", "road.js", "chart.js", "events.js", "panel.js", "player.js")
    script = "(() => {\n'use strict';\n" + "\n".join(map(text, scripts)) + "})();\n"
    parts = {
        "title": html.escape(title),
        "policy": f"default-src 'none'; img-src data:; style-src {_hash(style)}; script-src {_hash(script)}",
        "style": style,
        "script": script,
        "data": script_safe_json(data),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], text("page.html"))


def script_safe_json(data: Any) -> str:
    """JSON that neither ends nor comments out the script element around it."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _hash(text: str) -> str:
    """Name of an allowed script or style in the page's content security policy."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def series(values: npt.NDArray[np.float64], unit: float) -> list[int]:
    """[T] numbers as whole multiples of ``unit``, by their differences.

    Rounding errors do not add up.
    """
    whole = np.rint(np.nan_to_num(values) / unit).astype(np.int64)
    return np.diff(whole, prepend=np.int64(0)).tolist()


def steps(values: npt.NDArray[Any]) -> list[Any]:
    """[T] values as their changes, with two decimals; what is not finite becomes null."""

    def plain(value: float | int | bool) -> float | int | None:
        if isinstance(value, float):
            return round(value, 2) if np.isfinite(value) else None
        return int(value)

    rounded = [plain(value) for value in values.tolist()]
    changed = [
        index for index, value in enumerate(rounded) if index == 0 or value != rounded[index - 1]
    ]
    return [entry for index in changed for entry in (index, rounded[index])]


def episode_data(trajectory: Trajectory, stride: int = 1) -> dict[str, Any]:
    """A trajectory as JSON-serialisable data.

    Args:
        trajectory: a recorded episode.
        stride: frames from one sample to the next; the last frame is always a sample.

    Returns:
        The label's fields; ``outcome``; ``time`` (series); ``x, y, heading, speed`` (a series per
        vehicle); ``length, width, target_lane, valid`` (steps per vehicle); ``acceleration`` and
        ``jerk`` of the ego (series); ``action, reward, return`` (steps, of the decision that is
        carried out from a sample on); ``action_values`` (steps per action; empty if unknown) with
        ``action_names``; ``comfort`` (:meth:`Trajectory.comfort`); ``soft_crash``, the ends of the
        decisions with any, s.
    """
    t = trajectory
    kept = np.union1d(np.arange(0, len(t), stride), len(t) - 1)
    under_way = np.minimum(kept + 1, len(t) - 1)

    def per_vehicle(name: str) -> npt.NDArray[Any]:
        return getattr(t, name)[kept].T

    return {
        **asdict(t.label),
        "outcome": t.outcome,
        "time": series(t.time_s[kept], UNITS["time"]),
        **{
            name: [series(row, UNITS[name]) for row in per_vehicle(name)]
            for name in ("x", "y", "heading", "speed")
        },
        **{
            name: [steps(row) for row in per_vehicle(name)]
            for name in ("length", "width", "target_lane", "valid")
        },
        "acceleration": series(t.acceleration[kept, 0], UNITS["acceleration"]),
        "jerk": series(t.jerk()[kept, 0], UNITS["jerk"]),
        "action": steps(t.action[under_way]),
        "reward": steps(t.reward[under_way]) if len(t.reward) else [],
        "return": steps(t.returns[kept]),
        "action_values": [steps(row) for row in t.action_values[under_way].T]
        if t.action_values.size
        else [],
        "action_names": list(ACTION_NAMES),
        "comfort": t.comfort(),
        "soft_crash": [round(float(time), 2) for time in t.soft_crash_s if time >= t.time_s[0]],
    }
