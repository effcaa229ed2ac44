"""Statistics of recorded driving as one sheet of six panels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ganlane.data import PooledStatistics, survival_curve
from ganlane.view.figures import COLOURS, FAINT, STYLE, FloatArray, panel_grid

#: Of each density.
_BINS = 80


@rc_context(STYLE)
def draw_recordings(statistics: PooledStatistics) -> Figure:
    """Speeds, accelerations, lane-change times, headways and gaps of recorded driving."""
    figure, (speed, acceleration, changes, headway, time_headway, gap) = panel_grid(6)
    _draw_changes(changes, statistics)
    # The limit follows the data; a few outliers must not squeeze the rest.
    fastest = min(60.0, 1.1 * statistics.sample("speed").max() + 1.0)
    # Differences of measured positions are noisy; over 1 s the noise averages out.
    accelerations = {"acceleration_raw": "as recorded", "acceleration_smoothed": "over 1 s"}
    followers = "followers' headway: median (gap - 2 m) / speed"
    for axes, title, unit, limits, names in (
        (speed, "speed", "m/s", (0.0, fastest), {"speed": ""}),
        (acceleration, "acceleration", "m/s²", (-5.0, 5.0), accelerations),
        (headway, followers, "s", (0.0, 6.0), {"headway": ""}),
        (time_headway, "time headway: gap / speed", "s", (0.0, 8.0), {"time_headway": ""}),
        (gap, "gap to the leader", "m", (0.0, 100.0), {"gap": ""}),
    ):
        axes.set(title=title, xlabel=unit, ylabel=f"density, per {unit}", xlim=limits)
        _draw_densities(axes, {names[name]: statistics.sample(name) for name in names})
    acceleration.legend(loc="upper right", fontsize=8)
    return figure


def _draw_densities(axes: Axes, samples: Mapping[str, FloatArray]) -> None:
    """Densities over the limits of the panel, and the share of the values beyond them."""
    for line, (label, sample) in enumerate(samples.items()):
        counts, edges = np.histogram(sample, _BINS, axes.get_xlim())
        # By all values, those beyond the limits too, so densities of panels can be compared.
        density = counts / (max(len(sample), 1) * (edges[1] - edges[0]))
        axes.plot((edges[1:] + edges[:-1]) / 2, density, color=COLOURS[line], label=label)
        # What the panel cuts off is said in words, so that the curve is not taken for all of it.
        beyond = 100.0 * (1.0 - counts.sum() / max(len(sample), 1))
        if len(sample) and beyond >= 0.05:
            axes.text(
                0.99,
                0.6 - 0.1 * line,
                f"{beyond:.1f} % beyond",
                ha="right",
                color=COLOURS[line],
                size=8,
                transform=axes.transAxes,
            )


def _draw_changes(axes: Axes, statistics: PooledStatistics) -> None:
    """Share of lane changes that last longer.

    With unfinished ones, whose durations are lower bounds (censored), and without.
    """
    axes.set(title="time to change lanes", xlabel="s", ylabel="share that lasts longer")
    changes = statistics.changes
    if not changes.complete.any():
        axes.text(
            0.5,
            0.5,
            "none recorded from start to end",
            ha="center",
            transform=axes.transAxes,
            color=FAINT,
        )
        return
    # Changes cut off by a track's end are censored: without them the times come out too short.
    lines = {
        "unfinished ones included": np.ones(len(changes), bool),
        "finished ones only": changes.complete,
    }
    for (label, those), colour in zip(lines.items(), COLOURS):
        times, shares = survival_curve(changes.duration_s[those], changes.complete[those])
        # The curve begins at 1, before the first change ends.
        x, y = np.append(0.0, times), np.append(1.0, shares)
        axes.step(x, y, where="post", color=colour, label=label)
    axes.legend(loc="upper right", fontsize=8)
