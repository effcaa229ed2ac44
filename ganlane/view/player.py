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

from ganlane.files import write_bytes
from ganlane.keys import PHYSICS_STEP_S
from ganlane.settings.actions import LANE, NUMBERED
from ganlane.settings.render import FilmConfig
from ganlane.view.record import FloatArray, Trajectory

#: Units of series.
UNITS = {
    "time": 0.01,  # s
    "x": 0.01,  # m
    "y": 0.01,  # m
    "heading": 0.001,  # rad
    "speed": 0.01,  # m/s
    "acceleration": 0.01,  # m/s2
    "jerk": 0.1,  # m/s3
}
#: The page's scripts, in the order in which they run.
_SCRIPTS = (
    "episode.js",
    "road.js",
    "chart.js",
    "events.js",
    "panel.js",
    "player.js",
)


def write_player(
    trajectories: Sequence[Trajectory], path: str | Path, look: FilmConfig | None = None
) -> Path:
    """Write :func:`player_page` to ``path``, atomically, and return it."""
    write_bytes(path, player_page(trajectories, look).encode())
    return Path(path)


def player_page(trajectories: Sequence[Trajectory], look: FilmConfig | None = None) -> str:
    """A whole HTML page that plays ``trajectories`` side by side, from ``look.start_s`` on.

    Raises:
        UserError: an episode is over by then.
    """
    look = look or FilmConfig()
    episodes = [episode_data(trajectory, look.start_s) for trajectory in trajectories]
    # Once each, in their order.
    labels = [trajectory.label for trajectory in trajectories]
    names = dict.fromkeys(f"{label.agent} on {label.traffic}" for label in labels)
    return _fill(", ".join(names), {"units": UNITS, "episodes": episodes})


def _fill(title: str, data: dict[str, Any]) -> str:
    """The template with its parts, all put in at once: braces within a part are not replaced."""
    folder = files("ganlane.view") / "player_page"

    def text(name: str) -> str:
        return (folder / name).read_text(encoding="utf-8")

    style = text("style.css")
    # In a function, so that the page's names are not global.
    script = "(() => {\n'use strict';\n" + "\n".join(map(text, _SCRIPTS)) + "})();\n"
    # Only these two texts may run: nothing that is put into the page as data can.
    allowed = f"style-src {_hash(style)}; script-src {_hash(script)}"
    parts = {
        "title": html.escape(title),
        "policy": f"default-src 'none'; img-src data:; {allowed}",
        "style": style,
        "script": script,
        "data": script_safe_json(data),
    }
    # ``{{title}}`` becomes the part "title". By a function, since backslashes in a replacement text
    # would be escapes.
    return re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], text("page.html"))


def script_safe_json(data: Any) -> str:
    """JSON that neither ends nor comments out the script element around it."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    # As escapes within JSON's strings these characters mean the same, and HTML does not see them.
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _hash(text: str) -> str:
    """Name of an allowed script or style in the page's content security policy."""
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


def series(values: FloatArray, unit: float) -> list[int]:
    """[T] numbers as whole multiples of ``unit``, by their differences.

    Rounding errors do not add up.
    """
    # Differences of the rounded values, not rounded differences: errors do not add up.
    whole = np.rint(np.nan_to_num(values) / unit).astype(np.int64)
    # The first difference is to 0, so it is the first value itself.
    return np.diff(whole, prepend=np.int64(0)).tolist()


def steps(values: npt.NDArray[Any]) -> list[Any]:
    """[T] values as their changes, with two decimals; what is not finite becomes null."""
    is_whole = values.dtype.kind != "f"
    changes: list[Any] = []
    for sample, value in enumerate(values.tolist()):
        shown: float | None = None
        if is_whole:
            shown = int(value)
        elif np.isfinite(value):
            shown = round(value, 2)
        # The list ends with the value before.
        if not changes or shown != changes[-1]:
            changes += (sample, shown)
    return changes


def episode_data(trajectory: Trajectory, start_s: float = 0.0) -> dict[str, Any]:
    """A trajectory as JSON-serialisable data.

    Args:
        trajectory: a recorded episode.
        start_s: time of the first sample.

    Returns:
        The label's fields; ``outcome``; ``time`` (series); ``x, y, heading, speed`` (a series per
        vehicle); ``length, width, target_lane, valid`` (steps per vehicle); ``acceleration`` and
        ``jerk`` of the ego (series); ``action, reward, return`` (steps, of the decision that is
        carried out from a sample on); ``action_values`` (steps per action) with ``action_names``;
        ``comfort``: the ego's ``rms_acceleration`` and ``hardest_braking`` (0 or below), m/s2, and
        ``rms_jerk``, m/s3; ``soft_crash``, the ends of the decisions with any, s. Rewards and
        action values are empty if unknown.

    Raises:
        UserError: the episode is over by ``start_s``.
    """
    t = trajectory.since(start_s)
    data: dict[str, Any] = {
        **asdict(t.label),
        "outcome": t.outcome,
        "time": series(t.time_s, UNITS["time"]),
    }
    # Arrays are [T, M]: a row of the transposed one is a vehicle's.
    for name in ("x", "y", "heading", "speed"):
        data[name] = [series(row, UNITS[name]) for row in getattr(t, name).T]
    for name in ("length", "width", "target_lane", "valid"):
        data[name] = [steps(row) for row in getattr(t, name).T]

    acceleration = t.acceleration[:, 0]
    # Of the whole episode, since the first sample needs the one before.
    jerk = ego_jerk(trajectory)[-len(t) :]
    hardest_braking = min(0.0, float(acceleration.min()))

    # A frame has the action and reward of the decision that led to it; the player shows those of
    # the decision that begins there, so they are taken from the next frame.
    under_way = np.minimum(np.arange(len(t)) + 1, len(t) - 1)
    reward: list[Any] = []
    if np.isfinite(t.reward).any():
        reward = steps(t.reward[under_way])
    # Rule-based drivers have no action values; the page gets an empty list for them.
    action_values: list[Any] = []
    if np.isfinite(t.action_values).any():
        action_values = [steps(row) for row in t.action_values[under_way].T]
    # What happened before the first sample is not shown.
    soft_crash_s = t.soft_crash_s[t.soft_crash_s >= t.time_s[0]]

    return data | {
        "acceleration": series(acceleration, UNITS["acceleration"]),
        "jerk": series(jerk, UNITS["jerk"]),
        "action": steps(t.action[under_way]),
        "reward": reward,
        "return": steps(t.returns),
        "action_values": action_values,
        "action_names": list(NUMBERED[LANE]),
        "comfort": {
            "rms_acceleration": _rms(acceleration),
            "rms_jerk": _rms(jerk),
            "hardest_braking": round(hardest_braking, 3),
        },
        "soft_crash": soft_crash_s.round(2).tolist(),
    }


def _rms(values: FloatArray) -> float:
    """Root mean square, to three decimals."""
    return round(float(np.sqrt(np.mean(values**2))), 3)


def ego_jerk(trajectory: Trajectory) -> FloatArray:
    """Change of the ego's acceleration since the frame before, m/s3, [T].

    0 in the first two frames, since the reset begins with no acceleration, and after a jump.
    """
    acceleration = trajectory.acceleration[:, 0]
    jerk = np.diff(acceleration, prepend=acceleration[0]) / PHYSICS_STEP_S
    # The episode begins without a past: no change of acceleration is known there.
    jerk[:2] = 0.0
    # A vehicle that was placed elsewhere has another acceleration, not a jerk.
    jerk[trajectory.jumped()[:, 0]] = 0.0
    return jerk
