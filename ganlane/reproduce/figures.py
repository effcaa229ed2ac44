"""The paper's figures, and the matrix drawn.

Forecasts (2), an episode among generated drivers (3), learning curves with the transfer (4).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import EngFormatter, NullLocator

from ganlane.agents.checkpoint import with_seeds
from ganlane.data import FRAME_S, default_scenes, read_scenes
from ganlane.errors import UserError
from ganlane.generator import load_generator, shipped_generator
from ganlane.generator.forecasts import paper_forecasts
from ganlane.generator.windows import (
    OBSERVED_POSITIONS,
    PRESENT,
    Windows,
    cut_windows,
    group_windows,
    scene_tracks,
)
from ganlane.reproduce.episodes import drive_episode
from ganlane.reproduce.report import Row, rows_of
from ganlane.settings.commands import ReproduceConfig
from ganlane.settings.traffic import TrafficConfig
from ganlane.sim.random import Stream
from ganlane.view.curves import plot_middle, read_metrics
from ganlane.view.figures import COLOURS, FAINT, INK, STYLE, FloatArray, add_legend, panel_grid
from ganlane.view.record import EpisodeLabel, Trajectory

#: Panels of Figure 2 by what the vehicle does, and samples drawn in each.
PANELS = {
    "starts a lane change": 3,
    "completes a lane change": 3,
    "goes steady": 2,
}
SAMPLES = 8
#: Frames of every recording from one window to the next.
_STRIDE = 5
#: Shortest distance that a vehicle drives in the 1.6 s of a window, m.
LEAST_M = 8.0
#: Figure 3: frames over each other, s from the first to the last, s of the episode to choose from,
#: m around the ego.
FRAMES = 4
SHOWN_S = 3.0
LONGEST_S = 30.0
AROUND_M = (-70.0, 130.0)
#: Ticks of the leads over MOBIL: linear up to 20, logarithmic beyond.
_LEADS = (-300, -100, -20, -10, 0, 10, 20, 100)


# Figure 2


def interesting(windows: Windows) -> list[tuple[str, int]]:
    """Kind and row of the windows to draw (:data:`PANELS`).

    A vehicle starts a lane change where it moves across in the future and has not before, completes
    one the other way round, and goes steady where it moves across least of all. No vehicle comes
    twice, and none that hardly moves.
    """
    along = windows.positions[:, :, 0]
    across = windows.positions[:, :, 1]
    before = np.abs(across[:, PRESENT] - across[:, 0])
    after = np.abs(across[:, -1] - across[:, PRESENT])
    scores = {
        "starts a lane change": after - 2.0 * before,
        "completes a lane change": before - 2.0 * after,
        "goes steady": -before - after,
    }
    moves = along[:, -1] - along[:, 0] > LEAST_M
    chosen: list[tuple[str, int]] = []
    seen: set[tuple[str, int]] = set()
    # The best of each kind, as many as there are panels for it.
    for kind, count in PANELS.items():
        wanted = len(chosen) + count
        for row in np.argsort(-scores[kind], kind="stable").tolist():
            vehicle = str(windows.scene[row]), int(windows.vehicle[row])
            if len(chosen) < wanted and moves[row] and vehicle not in seen:
                seen.add(vehicle)
                chosen.append((kind, row))
    return chosen


def forecasts_to_draw() -> pl.DataFrame:
    """Recorded vehicles that the shipped generator was not fitted to, and what it predicts.

    Returns:
        Columns ``panel``, ``kind`` (of :data:`PANELS`), ``path`` (``observed``, ``recorded``,
        ``mean`` with z = 0, ``sample 1`` to :data:`SAMPLES`), ``time_s``, ``ahead_m`` and
        ``left_m``, all relative to the present.

    Raises:
        UserError: the recordings are not at hand.
    """
    generator, metadata = load_generator(shipped_generator("paper"), "paper")
    # Predictions of what the generator was fitted to would flatter it.
    held_out = set(metadata["data"]["held_out"])
    tracks = scene_tracks(read_scenes(default_scenes()))
    scenes = [scene for scene in tracks if scene.name in held_out]
    if not scenes:
        names = ", ".join(sorted(held_out))
        raise UserError(f"the recordings have none of the scenes {names}, kept from the fit.")
    windows = cut_windows(scenes, _STRIDE)
    groups = group_windows(windows)
    # Paths after the present, each [W, frames, 2]. The mean is the same for every seed.
    later = {"recorded": windows.future}
    for seed in range(SAMPLES):
        drawn = paper_forecasts(generator, windows, groups, seed, samples=1)
        later |= {"mean": drawn["mean"], f"sample {seed + 1}": drawn["single"]}
    now = np.zeros((1, 2))
    parts = []
    for panel, (kind, row) in enumerate(interesting(windows)):
        paths = {name: np.concatenate([now, path[row]]) for name, path in later.items()}
        seen = windows.positions[row, :OBSERVED_POSITIONS] - windows.positions[row, PRESENT]
        # The observed path ends at the present, the others begin there.
        for name, path in {**paths, "observed": seen}.items():
            present = PRESENT if name == "observed" else 0
            # Time 0 is the present, in both directions.
            columns = {
                "panel": panel,
                "kind": kind,
                "path": name,
                "time_s": (np.arange(len(path)) - present) * FRAME_S,
                "ahead_m": path[:, 0],
                "left_m": path[:, 1],
            }
            parts.append(pl.DataFrame(columns))
    return pl.concat(parts)


@rc_context(STYLE)
def draw_forecasts(paths: pl.DataFrame) -> Figure:
    """Figure 2.

    The vehicles of :func:`forecasts_to_draw`, 0.8 s observed, then 0.8 s recorded and predicted.
    """
    colours = {
        "observed": FAINT,
        "recorded": INK,
        "predicted, z = 0": COLOURS[1],
        "predicted": COLOURS[4],
    }
    # What is drawn last lies above.
    styles: dict[str, dict[str, Any]] = {}
    for number in range(SAMPLES):
        styles[f"sample {number + 1}"] = {"color": colours["predicted"], "lw": 0.8}
    styles["mean"] = {"color": colours["predicted, z = 0"], "lw": 1.6}
    for name in ("observed", "recorded"):
        styles[name] = {"color": colours[name], "marker": ".", "ms": 3}
    panels = paths.partition_by("panel", maintain_order=True)
    figure, grid = panel_grid(len(panels), 2.5, 1.7)
    for axes, panel in zip(grid, panels):
        axes.set(
            title=panel["kind"][0],
            xlabel="m ahead",
            ylabel="m to the left",
        )
        for name, style in styles.items():
            path = panel.filter(pl.col("path") == name)
            axes.plot(
                path["ahead_m"],
                path["left_m"],
                **style,
            )
        low, high = axes.get_ylim()
        # At least 1.6 m of height, so that steady driving does not look like a lane change.
        middle = (low + high) / 2.0
        reach = max(0.8, (high - low) / 2.0)
        axes.set_ylim(middle - reach, middle + reach)
    add_legend(figure, colours)
    return figure


# Figure 3


def drive_beginning(config: ReproduceConfig, traffic: TrafficConfig) -> Trajectory:
    """Episode 0 of an agent that learnt on generated traffic, at most :data:`LONGEST_S` of it.

    Without such an agent the last one of ``config`` drives.
    """
    # The figure shows what generated traffic teaches.
    learnt = [name for name in config.agents if "agent_gan" in name]
    name = with_seeds([*learnt, config.agents[-1]][0])[0]
    stream = Stream.named(config.stream)
    return drive_episode(name, traffic, config, 0, stream, LONGEST_S)


def busiest(episode: Trajectory) -> pl.DataFrame:
    """The :data:`SHOWN_S` seconds of an episode in which the others near the ego move across most.

    Returns:
        Columns ``time_s``, ``vehicle`` (0: the ego), ``x_m`` (from where the ego is at first),
        ``y_m``, ``heading_rad``, ``length_m`` and ``width_m``; a vehicle that is placed elsewhere
        meanwhile is left out.
    """
    shown = min(round(SHOWN_S / FRAME_S), len(episode) - 1)
    ahead = episode.x - episode.x[:, :1]
    # Vehicles in view, the ego left out.
    near = episode.valid & (ahead > AROUND_M[0]) & (ahead < AROUND_M[1] / 2.0)
    near[:, 0] = False
    # How far each moves across within the seconds that start at a frame, [T - shown, M].
    across = np.abs(episode.y[shown:] - episode.y[: len(episode) - shown])
    # The start whose seconds have the most movement across in them, over all near vehicles.
    first = int(np.argmax((across * near[: len(across)]).sum(axis=1)))
    part = slice(first, first + shown + 1)
    # A vehicle that is recycled would draw a line across the picture.
    jumps = episode.jumped()[first + 1 : first + shown + 1].any(axis=0)
    chosen = np.flatnonzero(episode.valid[part].all(axis=0) & ~jumps)

    def of_chosen(name: str) -> FloatArray:
        """A field of the chosen vehicles, vehicle by vehicle."""
        return getattr(episode, name)[part][:, chosen].T.ravel()

    return pl.DataFrame(
        {
            "time_s": np.tile(episode.time_s[part], len(chosen)),
            "vehicle": np.repeat(chosen, shown + 1),
            "x_m": of_chosen("x") - episode.x[first, 0],
            "y_m": of_chosen("y"),
            "heading_rad": of_chosen("heading"),
            "length_m": of_chosen("length"),
            "width_m": of_chosen("width"),
        }
    )


@rc_context(STYLE)
def draw_episode(label: EpisodeLabel, tracks: pl.DataFrame) -> Figure:
    """Figure 3.

    :data:`FRAMES` frames of :func:`busiest` over each other, older ones fainter, and the paths.
    """
    figure = Figure(figsize=(9.0, 1.9))
    axes = figure.subplots()
    lane_m = label.lane_width_m
    times = tracks["time_s"].unique().sort().to_numpy()
    axes.set(
        xlim=AROUND_M,
        xlabel="m",
        yticks=[],
        aspect="equal",
    )
    axes.set_ylim(
        -0.75 * lane_m,
        (label.lanes - 0.25) * lane_m,
    )
    axes.set_title(f"{label.agent} on {label.traffic}, {times[0]:.1f} to {times[-1]:.1f} s")
    for line in range(label.lanes + 1):
        style: dict[str, Any] = {
            "color": FAINT,
            "ls": (0, (8, 8)),
        }
        if line in (0, label.lanes):
            style = {"color": INK, "ls": "-"}
        axes.axhline((line - 0.5) * lane_m, **style)
    colours = {
        "ego": COLOURS[1],
        "others": COLOURS[0],
    }
    # From the first to the last, at equal times.
    frames = np.linspace(0, len(times) - 1, FRAMES).round().astype(int)
    for track in tracks.partition_by("vehicle", maintain_order=True):
        colour = colours["ego" if track["vehicle"][0] == 0 else "others"]
        axes.plot(
            track["x_m"],
            track["y_m"],
            color=colour,
            lw=0.8,
        )
        for place, frame in enumerate(frames.tolist()):
            body = track.row(frame, named=True)
            length = body["length_m"]
            width = body["width_m"]
            axes.add_patch(
                Rectangle(
                    (body["x_m"] - length / 2.0, body["y_m"] - width / 2.0),
                    length,
                    width,
                    angle=np.rad2deg(body["heading_rad"]),
                    rotation_point="center",
                    lw=0,
                    color=colour,
                    alpha=(place + 1.0) / FRAMES,
                )
            )
    add_legend(figure, colours)
    return figure


# Figure 4


def read_curves(folders: Sequence[str]) -> pl.DataFrame | None:
    """The evaluations of training runs with two phases; None without any run.

    Returns:
        Columns ``run``, ``decisions`` (over both phases), ``mean_reward`` and ``phase`` (``first``
        or ``second``).

    Raises:
        UserError: a folder without evaluations of both phases.
    """
    parts = []
    for folder in map(Path, folders):
        before = 0
        for phase, path in (("first", folder / "pretrain"), ("second", folder)):
            curve = read_metrics(path / "evaluation.csv")
            parts.append(
                curve.select(
                    pl.lit(folder.name).alias("run"),
                    pl.col("decisions") + before,
                    "mean_reward",
                    pl.lit(phase).alias("phase"),
                )
            )
            # The second phase goes on counting where the first one ended.
            before = curve["decisions"][-1]
    return pl.concat(parts, how="vertical_relaxed") if parts else None


@rc_context(STYLE)
def draw_transfer(curves: pl.DataFrame, rows: Sequence[Row]) -> Figure:
    """Figure 4: every run of :func:`read_curves`, their median, and the range between them.

    The switch of the traffic is marked, and what Agent_IDM of ``rows`` earned on the new traffic
    before any training there.
    """
    figure = Figure(figsize=(7.0, 3.4))
    axes = figure.subplots()
    axes.set(
        title="evaluations during training",
        xlabel="decisions",
        ylabel="mean reward",
    )
    axes.xaxis.set_major_formatter(EngFormatter())
    for (_, phase), colour in zip(curves.group_by("phase", maintain_order=True), COLOURS):
        runs = phase.partition_by("run", maintain_order=True)
        points = [(run["decisions"].to_numpy(), run["mean_reward"].to_numpy()) for run in runs]
        plot_middle(axes, points, with_range=True, middle=np.median, color=colour)
        if len(points) > 1:
            for run in points:
                axes.plot(*run, color=colour, lw=0.5, alpha=0.6)
    # Where the second phase begins.
    switch = curves.filter(pl.col("phase") == "first")["decisions"].to_numpy().max()
    axes.axvline(
        switch,
        color=FAINT,
        ls=":",
    )
    for row in rows_of(rows, ["gan"], ["agent_idm"]):
        rewards = [training["mean_reward"] for training in row["each"]]
        axes.plot(
            [switch] * len(rewards),
            rewards,
            "x",
            color=COLOURS[1],
        )
    names = ("on idm_mobil", "on gan (x: before any training there)")
    add_legend(figure, dict(zip(names, COLOURS)))
    return figure


# The matrix


@rc_context(STYLE)
def draw_matrix(rows: Sequence[Row]) -> Figure:
    """Lead over MOBIL, one panel per traffic.

    The interval over trainings and episodes, a dot for each training.
    """
    mobil = {row["traffic"]: row["mean_reward"] for row in rows if row["driver"] == "mobil"}
    shown = [row for row in rows if row["minus_mobil"] is not None]
    drivers = list(dict.fromkeys(row["driver"] for row in shown))
    traffics = list(dict.fromkeys(row["traffic"] for row in shown))
    # All panels have one scale, so that traffics can be compared.
    bounds = [bound for row in shown for bound in row["minus_mobil_ci"]]
    lowest = min(-20.0, *bounds)
    highest = max(20.0, *bounds)
    figure, grid = panel_grid(len(traffics), 3.4, 1.3 + 0.19 * len(drivers))
    for place, (axes, traffic) in enumerate(zip(grid, traffics)):
        axes.axvline(0.0, color=FAINT, lw=0.9)
        axes.set(
            title=traffic,
            xlabel="mean reward minus MOBIL's",
            ylim=(len(drivers) - 0.5, -0.5),
        )
        # Most leads lie within 20, those of random driving far below.
        axes.set_xscale("symlog", linthresh=20.0)
        axes.set_yticks(range(len(drivers)), drivers if place % 3 == 0 else [])
        axes.set_xticks([x for x in _LEADS if lowest <= x <= highest])
        axes.set_xlim(1.15 * lowest, 1.15 * highest)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_locator(NullLocator())
        for row in shown:
            if row["traffic"] != traffic:
                continue
            line = drivers.index(row["driver"])
            trained = len(row["each"]) > 1
            colour = COLOURS[0] if trained else INK
            axes.plot(
                row["minus_mobil_ci"], [line] * 2, color=colour, lw=2.2, solid_capstyle="butt"
            )
            axes.plot(row["minus_mobil"], line, "o", color=colour)
            if trained:
                leads = [training["mean_reward"] - mobil[traffic] for training in row["each"]]
                axes.plot(leads, [line] * len(leads), "|", color=COLOURS[1], ms=6, mew=1)
    one = Line2D([], [], color=COLOURS[1], marker="|", ls="", ms=6, label="one training")
    names = {"a recipe: mean, 95 % over trainings and episodes": COLOURS[0], "a single driver": INK}
    add_legend(figure, names, [one])
    return figure
