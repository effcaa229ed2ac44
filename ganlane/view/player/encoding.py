"""An episode as plain data for the player: whole numbers of small units, of which only the differences are written.

A *series* [T] is a list of T whole numbers: the first sample, then each sample's difference from the one before.
*Steps* are values that change now and then: a flat list ``[sample, value, sample, value, ...]`` of the changes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ganlane.view.trajectory import ACTION_NAMES, Trajectory

FloatArray = npt.NDArray[np.float64]

#: What 1 stands for in a series: s, m, m, rad, m/s, m/s2, m/s3.
UNITS = {
    "time": 0.01,
    "x": 0.01,
    "y": 0.01,
    "heading": 0.001,
    "speed": 0.01,
    "acceleration": 0.01,
    "jerk": 0.1,
}
_PER_VEHICLE = ("x", "y", "heading", "speed")
_DIGITS = 2


def series(values: FloatArray, unit: float) -> list[int]:
    """[T] numbers as whole multiples of ``unit``, by their differences; rounding errors do not add up."""
    whole = np.rint(np.nan_to_num(values) / unit).astype(np.int64)
    return np.diff(whole, prepend=np.int64(0)).tolist()


def steps(values: npt.NDArray[Any]) -> list[Any]:
    """[T] values as their changes, with two decimals; what is not a number becomes null."""
    told = [_plain(value) for value in values.tolist()]
    changed = [index for index, value in enumerate(told) if index == 0 or value != told[index - 1]]
    return [entry for index in changed for entry in (index, told[index])]


def _plain(value: float | int | bool) -> float | int | None:
    if isinstance(value, float):
        return round(value, _DIGITS) if np.isfinite(value) else None
    return int(value)


def episode_data(trajectory: Trajectory, stride: int = 1) -> dict[str, Any]:
    """A trajectory as JSON-serialisable data.

    Args:
        trajectory: a recorded episode.
        stride: frames from one sample to the next; the last frame is always a sample.

    Returns:
        The label's fields; ``outcome``; ``time`` (series); ``x, y, heading, speed`` (a series per vehicle);
        ``length, width, target_lane, valid`` (steps per vehicle); ``acceleration`` and ``jerk`` of the ego (series);
        ``action, reward, return`` (steps, of the decision that is carried out from a sample on); ``action_values``
        (steps per action; empty where the driver tells none) with ``action_names``; ``comfort`` (see
        :meth:`Trajectory.comfort`).
    """
    t = trajectory
    kept = np.union1d(np.arange(0, len(t), stride), len(t) - 1)
    under_way = np.minimum(kept + 1, len(t) - 1)

    def per_vehicle(name: str) -> npt.NDArray[Any]:
        return getattr(t, name)[kept].T

    label = {"agent": t.label.agent, "traffic": t.label.traffic, "seed": t.label.seed, "episode": t.label.episode}
    return {
        **label,
        "lanes": t.label.lanes,
        "lane_width_m": t.label.lane_width_m,
        "outcome": t.outcome,
        "time": series(t.time_s[kept], UNITS["time"]),
        **{name: [series(row, UNITS[name]) for row in per_vehicle(name)] for name in _PER_VEHICLE},
        **{name: [steps(row) for row in per_vehicle(name)] for name in ("length", "width", "target_lane", "valid")},
        "acceleration": series(t.acceleration[kept, 0], UNITS["acceleration"]),
        "jerk": series(t.jerk()[kept, 0], UNITS["jerk"]),
        "action": steps(t.action[under_way]),
        "reward": steps(t.reward[under_way]) if len(t.reward) else [],
        "return": steps(t.returns[kept]),
        "action_values": [steps(row) for row in t.action_values[under_way].T] if t.action_values.size else [],
        "action_names": list(ACTION_NAMES),
        "comfort": t.comfort(),
    }
