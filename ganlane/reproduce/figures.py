"""The matrix drawn, and the paper's figures.

Forecasts (2), an episode among generated drivers (3), transfer (4).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import EngFormatter, NullLocator
from matplotlib.transforms import Affine2D

from ganlane.agents.checkpoint import with_seeds
from ganlane.build import Driver, make_driver, make_env, make_traffic
from ganlane.settings.commands import ReproduceConfig
from ganlane.settings.traffic import TrafficConfig
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
from ganlane.reproduce.report import Row, rows_of
from ganlane.sim.random import Stream
from ganlane.view.figures import COLOURS, FAINT, INK, STYLE, add_legend, panel_grid, read_metrics
from ganlane.view.record import EpisodeLabel, Trajectory, record_episode

#: Panels of Figure 2 by what the vehicle does, and samples drawn in each.
PANELS = {"starts a lane change": 3, "completes a lane change": 3, "goes steady": 2}
SAMPLES = 8
#: Frames of every recording from one window to the next.
_STRIDE = 5
#: Shortest distance that a vehicle drives in the 1.6 s of a window, m.
LEAST_M = 8.0
#: Figure 3: frames over each other, s from the first to the last, s of the episode to choose from,
#: m around the ego.
FRAMES, SHOWN_S, LONGEST_S, AROUND_M = 4, 3.0, 30.0, (-70.0, 130.0)
EGO, OTHER = COLOURS[1], COLOURS[0]
Positions = npt.NDArray[np.float64]


class Drawn(NamedTuple):
    """Figures by name, the numbers behind them, and why others are left out."""

    figures: dict[str, Figure]
    numbers: dict[str, pl.DataFrame]
    missing: dict[str, str]


def draw_all(config: ReproduceConfig, traffics: Mapping[str, TrafficConfig]) -> Drawn:
    """``figure_2``, where the recordings are at hand, and ``figure_3``, where ``gan`` is among the
    traffics.
    """
    drawn = Drawn({}, {}, {})
    try:
        drawn.numbers["figure_2"] = forecasts_to_draw()
        drawn.figures["figure_2"] = draw_forecasts(drawn.numbers["figure_2"])
    except UserError as error:
        drawn.missing["figure 2"] = str(error)
    if "gan" in traffics:
        learnt = [name for name in config.agents if "agent_gan" in name]
        name = with_seeds([*learnt, config.agents[-1]][0])[0]
        driver = make_driver(name, config.env, device=config.device)
        episode = drive_beginning(driver, traffics["gan"], config)
        drawn.numbers["figure_3"] = busiest(episode)
        drawn.figures["figure_3"] = draw_episode(episode.label, drawn.numbers["figure_3"])
    else:
        drawn.missing["figure 3"] = "the traffic gan is not among the traffics"
    return drawn


def interesting(windows: Windows) -> list[tuple[str, int]]:
    """Kind and row of the windows to draw, :data:`PANELS`, no vehicle twice, none that hardly
    moves.

    A vehicle starts a lane change where it moves across in the future and has not before, completes
    one the other way round, and goes steady where it moves across least of all.
    """
    along, across = windows.positions[:, :, 0], windows.positions[:, :, 1]
    before = np.abs(across[:, PRESENT] - across[:, 0])
    after = np.abs(across[:, -1] - across[:, PRESENT])
    moves = along[:, -1] - along[:, 0] > LEAST_M
    scores = {
        "starts a lane change": after - 2.0 * before,
        "completes a lane change": before - 2.0 * after,
        "goes steady": -before - after,
    }
    chosen, seen = [], set[tuple[str, int]]()
    for kind, count in PANELS.items():
        found = 0
        for row in np.argsort(-scores[kind], kind="stable"):
            vehicle = str(windows.scene[row]), int(windows.vehicle[row])
            if found < count and moves[row] and vehicle not in seen:
                seen.add(vehicle)
                chosen.append((kind, int(row)))
                found += 1
    return chosen


def forecasts_to_draw() -> pl.DataFrame:
    """Vehicles of the recordings that the shipped generator was not fitted to, observed, recorded
    and predicted.

    Returns:
        Columns ``panel``, ``kind`` (of :data:`PANELS`), ``path`` (``observed``, ``recorded``,
        ``mean`` with z = 0, ``sample 1`` to :data:`SAMPLES`), ``time_s``, ``ahead_m`` and
        ``left_m``, all relative to the present.

    Raises:
        UserError: the recordings are not at hand.
    """
    generator, metadata = load_generator(shipped_generator("paper"), "paper")
    held_out = set(metadata["data"]["held_out"])
    scenes = [
        scene for scene in scene_tracks(read_scenes(default_scenes())) if scene.name in held_out
    ]
    if not scenes:
        raise UserError(
            f"the recordings have none of the scenes {', '.join(sorted(held_out))}, kept from the fit."
        )
    windows = cut_windows(scenes, _STRIDE)
    groups = group_windows(windows)
    predicted: dict[str, Positions] = {}
    for seed in range(SAMPLES):
        drawn = paper_forecasts(generator, windows, groups, seed, samples=1)
        predicted |= {"mean": drawn["mean"], f"sample {seed + 1}": drawn["single"]}
    parts = []
    for panel, (kind, row) in enumerate(interesting(windows)):
        observed = windows.positions[row, :OBSERVED_POSITIONS] - windows.positions[row, PRESENT]
        later = {"recorded": windows.future, **predicted}
        paths = {
            name: np.concatenate([np.zeros((1, 2)), each[row]]) for name, each in later.items()
        }
        for name, path in {**paths, "observed": observed}.items():
            time_s = (np.arange(len(path)) - (PRESENT if name == "observed" else 0)) * FRAME_S
            columns = {"time_s": time_s, "ahead_m": path[:, 0], "left_m": path[:, 1]}
            parts.append(
                pl.DataFrame(columns).select(
                    pl.lit(panel).alias("panel"),
                    pl.lit(kind).alias("kind"),
                    # fmt: skip
                    pl.lit(name).alias("path"),
                    pl.all(),
                )
            )
    return pl.concat(parts)


@rc_context(STYLE)
def draw_forecasts(paths: pl.DataFrame) -> Figure:
    """Figure 2.

    The vehicles of :func:`forecasts_to_draw`, 0.8 s observed, then 0.8 s recorded and predicted.
    """
    panels = paths.partition_by("panel", maintain_order=True)
    figure, grid = panel_grid(len(panels), 2.5, 1.7)
    colours = {
        "observed": FAINT,
        "recorded": INK,
        "predicted, z = 0": COLOURS[1],
        "predicted": COLOURS[4],
    }
    styles: dict[str, dict[str, Any]] = {
        **{
            f"sample {number + 1}": {"color": colours["predicted"], "lw": 0.8}
            for number in range(SAMPLES)
        },
        "mean": {"color": colours["predicted, z = 0"], "lw": 1.6},
        **{
            name: {"color": colours[name], "marker": ".", "ms": 3}
            for name in ("observed", "recorded")
        },
    }
    for axes, panel in zip(grid, panels):
        axes.set(title=panel["kind"][0], xlabel="m ahead", ylabel="m to the left")
        for name, style in styles.items():  # what is drawn last lies above
            path = panel.filter(pl.col("path") == name)
            axes.plot(path["ahead_m"], path["left_m"], **style)
        low, high = axes.get_ylim()
        reach = max(0.8, (high - low) / 2.0)
        axes.set_ylim((low + high) / 2.0 - reach, (low + high) / 2.0 + reach)
    add_legend(figure, colours)
    return figure


def drive_beginning(driver: Driver, traffic: TrafficConfig, config: ReproduceConfig) -> Trajectory:
    """Episode 0, at most :data:`LONGEST_S` of it."""
    seen = config.observation.read_by(driver.observation)
    mask, policy = driver.behind(config.mask)
    made = make_traffic(traffic, config.env, Stream[config.stream.upper()])
    env = make_env(made, config.env, seen, config.reward, device=config.device, mask=mask)
    return record_episode(env, policy, config.seed, 0, driver.name, traffic.label(), LONGEST_S)


def busiest(episode: Trajectory) -> pl.DataFrame:
    """The :data:`SHOWN_S` seconds of an episode in which the others near the ego move across most.

    Returns:
        Columns ``time_s``, ``vehicle`` (0: the ego), ``x_m`` (from where the ego is at first),
        ``y_m``, ``heading_rad``, ``length_m`` and ``width_m``; a vehicle that is placed elsewhere
        meanwhile is left out.
    """
    shown = min(round(SHOWN_S / episode.frame_s), len(episode) - 1)
    ahead = episode.x - episode.x[:, :1]
    near = episode.valid & (ahead > AROUND_M[0]) & (ahead < AROUND_M[1] / 2.0)
    near[:, 0] = False
    across = np.abs(episode.y[shown:] - episode.y[: len(episode) - shown])
    first = int(np.argmax((across * near[: len(across)]).sum(axis=1)))
    part, origin = slice(first, first + shown + 1), episode.x[first, 0]
    stays = episode.valid[part].all(axis=0) & ~episode.jumped()[first + 1 : first + shown + 1].any(
        axis=0
    )
    numbers = {
        "x_m": episode.x - origin, "y_m": episode.y, "heading_rad": episode.heading,
        "length_m": episode.length, "width_m": episode.width,
    }  # fmt: skip
    return pl.concat(
        pl.DataFrame(
            {
                "time_s": episode.time_s[part],
                **{name: each[part, vehicle] for name, each in numbers.items()},
            }
        ).insert_column(1, pl.lit(int(vehicle)).alias("vehicle"))
        for vehicle in np.flatnonzero(stays)
    )


@rc_context(STYLE)
def draw_episode(label: EpisodeLabel, tracks: pl.DataFrame) -> Figure:
    """Figure 3.

    :data:`FRAMES` frames of :func:`busiest` over each other, older ones fainter, and the paths.
    """
    figure = Figure(figsize=(9.0, 1.9))
    axes = figure.subplots()
    width_m, times = label.lane_width_m, tracks["time_s"].unique().sort().to_numpy()
    axes.set(xlim=AROUND_M, xlabel="m", yticks=[], aspect="equal")
    axes.set_ylim(-0.75 * width_m, (label.lanes - 0.25) * width_m)
    axes.set_title(f"{label.agent} on {label.traffic}, {times[0]:.1f} to {times[-1]:.1f} s")
    for line in range(label.lanes + 1):
        edge = line in (0, label.lanes)
        axes.axhline(
            (line - 0.5) * width_m, color=INK if edge else FAINT, ls="-" if edge else (0, (8, 8))
        )
    frames = np.linspace(0, len(times) - 1, FRAMES).round().astype(int)
    for track in tracks.partition_by("vehicle", maintain_order=True):
        colour = EGO if track["vehicle"][0] == 0 else OTHER
        axes.plot(track["x_m"], track["y_m"], color=colour, lw=0.8)
        for place, frame in enumerate(frames):
            _draw_body(
                axes, track.row(int(frame), named=True), color=colour, alpha=(place + 1.0) / FRAMES
            )
    add_legend(figure, {"ego": EGO, "others": OTHER})
    return figure


def _draw_body(axes: Axes, at: dict[str, float], **style: Any) -> None:
    length, width = at["length_m"], at["width_m"]
    turned = Affine2D().rotate(at["heading_rad"]).translate(at["x_m"], at["y_m"]) + axes.transData
    axes.add_patch(
        Rectangle((-length / 2.0, -width / 2.0), length, width, lw=0, transform=turned, **style)
    )


#: Ticks of the leads: linear up to 20, logarithmic beyond.
_LEADS = (-300, -100, -20, -10, 0, 10, 20, 100)


@rc_context(STYLE)
def draw_matrix(rows: Sequence[Row]) -> Figure:
    """Lead over MOBIL, one panel per traffic.

    The interval over trainings and episodes, a dot for each training.
    """
    drawn = [row for row in rows if row["minus_mobil"] is not None]
    drivers = list(dict.fromkeys(row["driver"] for row in drawn))
    traffics = list(dict.fromkeys(row["traffic"] for row in drawn))
    mobil = {row["traffic"]: row["mean_reward"] for row in rows if row["driver"] == "mobil"}
    bounds = [bound for row in drawn for bound in row["minus_mobil_ci"] or (row["minus_mobil"],)]
    lowest, highest = min(-20.0, *bounds), max(20.0, *bounds)
    figure, grid = panel_grid(len(traffics), 3.4, 1.3 + 0.19 * len(drivers))
    for place, (axes, traffic) in enumerate(zip(grid, traffics)):
        axes.axvline(0.0, color=FAINT, lw=0.9)
        axes.set(title=traffic, xlabel="mean reward minus MOBIL's", ylim=(len(drivers) - 0.5, -0.5))
        axes.set_xscale("symlog", linthresh=20.0)
        axes.set_yticks(range(len(drivers)), drivers if place % 3 == 0 else [])
        axes.set_xticks([x for x in _LEADS if lowest <= x <= highest], minor=False)
        axes.set_xlim(1.15 * lowest, 1.15 * highest)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_locator(NullLocator())
        for row in drawn:
            if row["traffic"] == traffic:
                line, trained = drivers.index(row["driver"]), len(row["each"]) > 1
                colour = COLOURS[0] if trained else INK
                low, high = row["minus_mobil_ci"] or (row["minus_mobil"],) * 2
                axes.plot([low, high], [line, line], color=colour, lw=2.2, solid_capstyle="butt")
                axes.plot(row["minus_mobil"], line, "o", color=colour)
                each = [training["mean_reward"] - mobil[traffic] for training in row["each"]]
                if trained:
                    axes.plot(each, [line] * len(each), "|", color=COLOURS[1], ms=6, mew=1)
    one = Line2D([], [], color=COLOURS[1], marker="|", ls="", ms=6, label="one training")
    names = {"a recipe: mean, 95 % over trainings and episodes": COLOURS[0], "a single driver": INK}
    add_legend(figure, names, [one])
    return figure


@dataclass(frozen=True)
class Transfer:
    """Learning curves over the decisions.

    Both phases, one line per run, and what the agent earned at the switch.
    """

    runs: Mapping[str, pl.DataFrame]
    switch: float
    at_switch: Sequence[float]


def read_transfers(folders: Sequence[str], rows: Sequence[Row]) -> Transfer | None:
    """The evaluations of training runs with two phases; None without any run.

    Raises:
        UserError: a folder without evaluations of both phases.
    """
    runs: dict[str, pl.DataFrame] = {}
    switch = 0.0
    for folder in map(Path, folders):
        first, second = (
            read_metrics(part / "evaluation.csv").select("decisions", "mean_reward")
            for part in (folder / "pretrain", folder)
        )
        switch = max(switch, float(first["decisions"][-1]))
        later = second.with_columns(pl.col("decisions") + first["decisions"][-1])
        phases = [
            first.with_columns(phase=pl.lit("first")),
            later.with_columns(phase=pl.lit("second")),
        ]
        runs[folder.name] = pl.concat(phases, how="vertical_relaxed")
    ours = rows_of(rows, ["gan"], ["agent_idm"])
    return (
        Transfer(runs, switch, [each["mean_reward"] for row in ours for each in row["each"]])
        if runs
        else None
    )


@rc_context(STYLE)
def draw_transfer(transfer: Transfer) -> Figure:
    """Figure 4: every run, their median, and the range between them.

    The switch of the traffic is marked.
    """
    figure = Figure(figsize=(7.0, 3.4))
    axes = figure.subplots()
    axes.set(title="evaluations during training", xlabel="decisions", ylabel="mean reward")
    axes.xaxis.set_major_formatter(EngFormatter())
    for phase, colour in zip(("first", "second"), COLOURS):
        lines = [frame.filter(pl.col("phase") == phase) for frame in transfer.runs.values()]
        x = lines[0]["decisions"].cast(pl.Float64).to_numpy()
        y = np.stack(
            [
                np.interp(x, line["decisions"].to_numpy(), line["mean_reward"].to_numpy())
                for line in lines
            ]
        )
        axes.fill_between(x, y.min(axis=0), y.max(axis=0), color=colour, alpha=0.2, lw=0)
        axes.plot(x, np.median(y, axis=0), color=colour)
        for line in lines if len(lines) > 1 else []:
            axes.plot(line["decisions"], line["mean_reward"], color=colour, lw=0.5, alpha=0.6)
    axes.axvline(transfer.switch, color=FAINT, ls=":")
    if transfer.at_switch:
        axes.plot(
            [transfer.switch] * len(transfer.at_switch), transfer.at_switch, "x", color=COLOURS[1]
        )
    add_legend(
        figure, {"on idm_mobil": COLOURS[0], "on gan (x: before any training there)": COLOURS[1]}
    )
    return figure
