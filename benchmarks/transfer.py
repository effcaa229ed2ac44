"""The paper's Figure 4: learning curves of trainings in two phases, the change of traffic marked.

    python -m benchmarks.transfer

draws ``docs/reproduce/figure_4.png`` from the evaluations in ``docs/learning_curves/seed_*`` and
from Agent_IDM's rewards in ``docs/reproduce/results.json``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import polars as pl
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from benchmarks import printed
from benchmarks.script import ROOT, make_parser, run_script
from ganlane.view.curves import plot_middle, read_metrics
from ganlane.view.figures import COLOURS, FAINT, STYLE, add_legend, save_figure

DOCS = ROOT / "docs"
FIGURE = DOCS / "reproduce" / "figure_4.png"


def read_curves(folders: Sequence[Path]) -> pl.DataFrame:
    """The evaluations of training runs with two phases.

    Returns:
        Columns ``run``, ``decisions`` (over both phases), ``mean_reward`` and ``phase`` (``first``
        or ``second``).

    Raises:
        UserError: a folder without evaluations of both phases.
    """
    parts = []
    for folder in folders:
        before = 0
        for phase, path in (("first", folder / "pretrain"), ("second", folder)):
            curve = read_metrics(path / "evaluation.csv")
            labels = {"run": pl.lit(folder.name), "phase": pl.lit(phase)}
            parts.append(curve.select(pl.col("decisions") + before, "mean_reward", **labels))
            # The second phase goes on counting where the first one ended.
            before = curve["decisions"][-1]
    return pl.concat(parts, how="vertical_relaxed")


@rc_context(STYLE)
def draw_transfer(curves: pl.DataFrame, before: Sequence[float]) -> Figure:
    """Every run of :func:`read_curves`, their median, and the range between them.

    The crosses are ``before``: rewards on the new traffic before any training there.
    """
    figure = Figure(figsize=(7.0, 3.4))
    axes = figure.subplots()
    axes.set(title="evaluations during training", xlabel="decisions", ylabel="mean reward")
    axes.xaxis.set_major_formatter(EngFormatter())
    for (_, phase), colour in zip(curves.group_by("phase", maintain_order=True), COLOURS):
        runs = phase.partition_by("run", maintain_order=True)
        points = [(run["decisions"].to_numpy(), run["mean_reward"].to_numpy()) for run in runs]
        plot_middle(axes, points, middle=np.median, color=colour)
        for run in points:
            axes.plot(*run, color=colour, lw=0.5, alpha=0.6)
    # Where the second phase begins.
    switch = curves.filter(pl.col("phase") == "first")["decisions"].to_numpy().max()
    axes.axvline(switch, color=FAINT, ls=":")
    axes.plot([switch] * len(before), before, "x", color=COLOURS[1])
    names = ("on idm_mobil", "on gan (x: before any training there)")
    add_legend(figure, dict(zip(names, COLOURS)))
    return figure


def draw(options: argparse.Namespace) -> str:
    """Draw the figure; the line that names it."""
    row = printed.at(printed.load(), "agent_idm+none", "gan")
    before = [training["mean_reward"] for training in row["each"]]
    curves = read_curves(sorted((DOCS / "learning_curves").glob("seed_*")))
    return f"figure: {save_figure(draw_transfer(curves, before), FIGURE)}"


if __name__ == "__main__":
    sys.exit(run_script(draw, make_parser(__doc__).parse_args()))
