"""Which property of human-like traffic does an agent learn from?

    python -m benchmarks.dose train
    python -m benchmarks.dose table
    python -m benchmarks.dose figure

The first takes hours on one core and goes on where it ended. For two cores: `train --part 0 2`
beside `train --part 1 2`.

Every training is the same: MaskablePPO as in `examples/sb3_ppo.py`, from random weights, among
`human` drivers with one property changed, or among other drivers altogether. Its agent then drives
on traffics that no training met. The table has, for each dose, the difference to the trainings
among unchanged drivers: reward, and failures (crashes and departures) per 1000 episodes; the unit
of the intervals is the training. It needs `pip install 'ganlane[sb3]'` and no recordings.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl
from matplotlib import rc_context
from matplotlib.figure import Figure

from benchmarks.script import ROOT, ReportSection, add_report, make_parser, markdown, run_script
from ganlane import api
from ganlane.errors import UserError
from ganlane.evaluation.statistics import Estimate, difference, entries
from ganlane.evaluation.table import Table, with_interval, with_sign
from ganlane.files import atomic_path
from ganlane.settings.suite import PUBLISHED
from ganlane.view.figures import COLOURS, FAINT, STYLE, save_figure

#: Values of each property; what is not named is as fitted.
DOSES: dict[str, tuple[Any, ...]] = {
    "lane_changes": (0.0, 0.9, 3.6),
    "politeness": (0.0, 3.0),
    "temperature": (0.3, 1.2, 1.6),
    "delayed": (1, 2),
    "blind_share": (0.1, 0.3, 1.0),
    "desired_speed_mps": ((21.0, 23.0), (14.0, 30.0)),
    "traffic": ("idm_mobil", "gan"),
}
#: Properties of the environment rather than of its drivers.
OF_ENVIRONMENT = ("desired_speed_mps", "traffic")
#: The drivers that all trainings meet, so that a table is of the same ones: the first weights.
DRIVERS = {"name": "human", **PUBLISHED["shift-v1"]["human"]}
UNCHANGED = "as fitted"
MASK = "legal"
#: Traffics that no training met.
HELD_OUT = ("idm_faults", "idm_random", "gan_calibrated")
#: Those on which some were trained; the agents of these drive on all of them.
MET = ("idm_mobil", "human", "gan")
EPISODES = 300
MOST_SEEDS = 10
DECISIONS = 1_500_000
ROWS = 256
#: Of the two tables in a document.
SECTIONS = ("dose", "dose traffics")
FIGURE = ROOT / "docs" / "figures" / "dose.png"


class Training(NamedTuple):
    """A training: varied property and its dose, seed."""

    varied: str = UNCHANGED
    dose: Any = None
    seed: int = 0

    @property
    def traffic(self) -> str:
        """The drivers that it met, by their name."""
        return self.dose if self.varied == "traffic" else "human"

    def driven(self) -> tuple[str, ...]:
        """The traffics that its agent drives on."""
        compares_traffics = self.varied in (UNCHANGED, "traffic")
        return HELD_OUT + MET if compares_traffics else HELD_OUT

    @property
    def file(self) -> str:
        """Where its agent's held-out episodes are."""
        dose = "" if self.dose is None else f"_{self.dose}".replace(" ", "")
        return f"{self.varied.replace(' ', '_')}{dose}_{self.seed}.parquet"

    def settings(self) -> dict[str, Any]:
        """Options of its environment."""
        changed = {} if self.dose is None else {self.varied: self.dose}
        if self.varied in OF_ENVIRONMENT:
            return {"traffic": DRIVERS, **changed}
        return {"traffic": {**DRIVERS, **changed}}


def trainings(seeds: int, properties: Sequence[str] = tuple(DOSES)) -> Iterator[Training]:
    """All of these ``properties``, seed by seed, so that one whole table is soon there."""
    for seed in range(seeds):
        yield Training(seed=seed)
        for name in properties:
            for dose in DOSES[name]:
                yield Training(name, dose, seed)


def trained(training: Training) -> api.Driver:
    """The agent of a training."""
    # Only here: the table is made without stable-baselines3.
    from sb3_contrib import MaskablePPO

    from examples.sb3_ppo import learner
    from ganlane import sb3

    env = sb3.make_vec_env(
        num_envs=ROWS,
        seed=training.seed,
        observation="road_view",
        mask=MASK,
        **training.settings(),
    )
    model = learner(MaskablePPO, env, training.seed)
    return sb3.driver(model.learn(DECISIONS))


def train(folder: Path, chosen: Sequence[Training]) -> str:
    """Make the trainings that are missing, and drive their agents."""
    for training in chosen:
        episodes = folder / training.file
        if episodes.is_file():
            continue
        traffics = [DRIVERS if name == "human" else name for name in training.driven()]
        table = api.evaluate(
            [trained(training)], traffics, episodes=EPISODES, per_episode=True, threads=1
        )
        failed = pl.col("reason").is_in(["hard_crash", "out_of_road"])
        table = table.select("traffic", "episode", pl.col("reward").cast(pl.Float32), failed=failed)
        with atomic_path(episodes) as unfinished:
            table.write_parquet(unfinished)
        print(f"{training.file}: done", flush=True)
    return f"{len(chosen)} trainings in {folder}"


def scores(
    folder: Path, training: Training, traffics: Sequence[str] = HELD_OUT
) -> dict[str, npt.NDArray[np.float64]]:
    """Rewards and failures [S, E] of all seeds of a dose on ``traffics``; empty where there are
    none.
    """
    rewards, failures = [], []
    for seed in range(MOST_SEEDS):
        path = folder / training._replace(seed=seed).file
        if path.is_file():
            table = pl.read_parquet(path).filter(pl.col("traffic").is_in(traffics))
            table = table.sort("traffic", "episode")
            rewards.append(table["reward"])
            failures.append(1000.0 * table["failed"])
    if not rewards:
        return {}
    return {"reward": np.stack(rewards), "failures": np.stack(failures)}


class Effect(NamedTuple):
    """What a dose changed: the difference to trainings among unchanged drivers."""

    training: Training
    seeds: int
    scores: dict[str, Estimate]  # reward, and failures per 1000 episodes


def effects(folder: Path) -> Iterator[Effect]:
    """Of all doses that were tried; of unchanged drivers themselves the means, without interval.

    Raises:
        UserError: there are no trainings among unchanged drivers to compare with.
    """
    unchanged, *doses = trainings(1)
    baseline = scores(folder, unchanged)
    if not baseline:
        raise UserError(f"--folder {folder}: no finished trainings; run 'train' first.")
    means = {name: Estimate(float(values.mean())) for name, values in baseline.items()}
    yield Effect(unchanged, len(baseline["reward"]), means)
    for training in doses:
        changed = scores(folder, training)
        if changed:
            changes = {name: difference(changed[name], baseline[name]) for name in changed}
            yield Effect(training, len(changed["reward"]), changes)


def dose_table(folder: Path) -> Table:
    """The table of :func:`effects`."""
    rows = []
    for effect in effects(folder):
        varied, dose, _ = effect.training
        dose = "" if dose is None else str(dose)
        cells = [
            with_interval(entries(name, value), name, 1) for name, value in effect.scores.items()
        ]
        rows.append([varied, dose, str(effect.seeds), *cells])
    heads = ["property", "dose", "trainings", "reward", "failures/1000 episodes"]
    return Table("", heads, rows, names=2)


def transfer_table(folder: Path) -> Table:
    """Mean reward, and what it is over drivers as fitted, of each traffic of training on each
    traffic; italics: met in training.
    """
    rows = []
    unchanged, *others = trainings(1, ["traffic"])
    baseline = {name: scores(folder, unchanged, [name]) for name in unchanged.driven()}
    for training in (unchanged, *others):
        cells = []
        seeds = 0
        for traffic in training.driven():
            rewards = scores(folder, training, [traffic]).get("reward")
            if rewards is None:
                break
            seeds = len(rewards)
            text = f"{rewards.mean():.1f}"
            if training != unchanged:
                change = entries("reward", difference(rewards, baseline[traffic]["reward"]))
                text = f"{text}; {with_sign(change, 'reward', 1)}"
            cells.append(f"*{text}*" if traffic == training.traffic else text)
        if cells:
            rows.append([f"`{training.traffic}`", str(seeds), *cells])
    heads = ["trained on", "trainings", *(f"`{name}`" for name in unchanged.driven())]
    return Table("", heads, rows, names=1)


@rc_context(STYLE)
def draw_effects(changes: Sequence[Effect]) -> Figure:
    """A panel for each property: what each dose changed in reward, with its 95 % interval."""
    figure = Figure(figsize=(9.0, 4.6))
    panels = figure.subplots(2, -(-len(DOSES) // 2), sharey=True).ravel()
    for panel, (name, doses) in zip(panels, DOSES.items()):
        panel.axhline(0.0, color=FAINT, ls=":")
        panel.set_xticks(range(len(doses)), map(str, doses))
        panel.set(title=name, xlim=(-0.5, len(doses) - 0.5))
        for effect in changes:
            varied, dose, _ = effect.training
            reward = effect.scores["reward"]
            if varied != name or reward.interval is None:
                continue
            place = doses.index(dose)
            panel.plot([place, place], reward.interval, color=COLOURS[0])
            panel.plot(place, reward.value, "o", color=COLOURS[0])
    for panel in panels[len(DOSES) :]:
        panel.set_axis_off()
    figure.supylabel("reward, difference to drivers as fitted")
    return figure


def measure(arguments: argparse.Namespace) -> str:
    """One of the three."""
    folder = arguments.folder
    if arguments.action == "table":
        sections = [ReportSection(arguments.report, name) for name in SECTIONS]
        tables = [dose_table(folder), transfer_table(folder)]
        for section, table in zip(sections, tables):
            section.write(markdown(table))
        return "\n\n".join(table.text() for table in tables)
    if arguments.action == "figure":
        return f"figure: {save_figure(draw_effects(list(effects(folder))), FIGURE)}"
    part, parts = arguments.part
    return train(folder, list(trainings(arguments.seeds, arguments.properties))[part::parts])


def main(arguments: Sequence[str] | None = None) -> int:
    """The script."""
    parser = make_parser(__doc__)
    parser.add_argument("action", choices=("train", "table", "figure"))
    parser.add_argument("--folder", type=Path, default=Path("outputs/dose"))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument(
        "--properties", nargs="+", choices=tuple(DOSES), default=tuple(DOSES), help="of training"
    )
    add_report(parser, SECTIONS[0])
    parser.add_argument(
        "--part", nargs=2, type=int, default=(0, 1), help="which of how many, from 0: 0 2"
    )
    return run_script(measure, parser.parse_args(arguments))


if __name__ == "__main__":
    sys.exit(main())
