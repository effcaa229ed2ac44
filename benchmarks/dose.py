"""Which property of human-like traffic does an agent learn from?

    python -m benchmarks.dose train
    python -m benchmarks.dose table

The first takes hours on one core and goes on where it ended. For two cores: `train --part 0/2`
beside `train --part 1/2`.

Every training is the same: MaskablePPO of sb3-contrib, from random weights, among `human` drivers
with one property changed. Its agent then drives on traffics that no training met. The table has,
for each dose, the difference to the trainings among unchanged drivers: reward, and failures
(crashes and departures) per 1000 episodes; the unit of the intervals is the training. It needs
`pip install 'ganlane[sb3]'` and no recordings.
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
import torch

from benchmarks.script import make_parser, run_script
from ganlane import api
from ganlane.errors import UserError
from ganlane.evaluation.statistics import difference, entries
from ganlane.evaluation.table import Table, with_interval
from ganlane.files import atomic_path
from ganlane.settings.suite import PUBLISHED

#: Values of each property; what is not named is as fitted.
DOSES: dict[str, tuple[Any, ...]] = {
    "lane_changes": (0.0, 0.9, 3.6),
    "politeness": (0.0, 3.0),
    "temperature": (0.3, 1.2, 1.6),
    "delayed": (1, 2),
    "blind_share": (0.1, 0.3, 1.0),
    "desired_speed_mps": ((21.0, 23.0), (14.0, 30.0)),
}
#: Properties of the scene rather than of the traffic.
OF_SCENE = ("desired_speed_mps",)
#: The drivers that all trainings meet, so that a table is of the same ones: the first weights.
DRIVERS = {"name": "human", **PUBLISHED["shift-v1"]["human"]}
UNCHANGED = "as fitted"
MASKS = ("legal", "safe")
#: Traffics that no training met.
HELD_OUT = ("idm_faults", "idm_random", "gan_calibrated")
EPISODES = 300
DECISIONS = 1_500_000
ROWS = 256


class Training(NamedTuple):
    """A training: mask, varied property and its dose (None: unchanged drivers), seed."""

    mask: str
    varied: str
    dose: Any
    seed: int

    @property
    def file(self) -> str:
        """Where its agent's held-out episodes are."""
        dose = "" if self.dose is None else f"_{self.dose}".replace(" ", "")
        return f"{self.mask}_{self.varied.replace(' ', '_')}{dose}_{self.seed}.parquet"

    def settings(self) -> dict[str, Any]:
        """Options of its environment."""
        changed = {} if self.dose is None else {self.varied: self.dose}
        if self.varied in OF_SCENE:
            return {"traffic": DRIVERS, **changed}
        return {"traffic": {**DRIVERS, **changed}}


def trainings(seeds: int) -> Iterator[Training]:
    """All of them; all seeds of a mask come first, so that one whole table is soon there."""
    for mask in MASKS:
        for seed in range(seeds):
            yield Training(mask, UNCHANGED, None, seed)
            for name, doses in DOSES.items():
                for dose in doses:
                    yield Training(mask, name, dose, seed)


def trained(training: Training) -> api.Driver:
    """The agent of a training; the settings are those of ``examples/sb3_ppo.py``."""
    # Only here: the table is made without stable-baselines3.
    from sb3_contrib import MaskablePPO

    from ganlane import sb3

    env = sb3.make_vec_env(
        num_envs=ROWS,
        seed=training.seed,
        observation="road_view",
        mask=training.mask,
        **training.settings(),
    )
    model = MaskablePPO(
        "MlpPolicy",
        env,
        learning_rate=lambda left: 1e-3 * left,
        n_steps=64,
        batch_size=2048,
        n_epochs=5,
        gamma=0.98,
        gae_lambda=0.9,
        ent_coef=0.01,
        policy_kwargs={"net_arch": [128, 128]},
        seed=training.seed,
    )
    return sb3.driver(model.learn(DECISIONS))


def train(folder: Path, seeds: int, part: int, parts: int) -> str:
    """Make the trainings that are missing, and drive the agents on the held-out traffics."""
    torch.set_num_threads(1)  # small networks: a second thread only costs
    chosen = list(trainings(seeds))[part::parts]
    for training in chosen:
        episodes = folder / training.file
        if episodes.is_file():
            continue
        table = api.evaluate(
            [trained(training)], list(HELD_OUT), episodes=EPISODES, per_episode=True, threads=1
        )
        failed = pl.col("reason").is_in(["hard_crash", "out_of_road"])
        table = table.select("traffic", "episode", pl.col("reward").cast(pl.Float32), failed=failed)
        with atomic_path(episodes) as unfinished:
            table.write_parquet(unfinished)
        print(f"{training.file}: done", flush=True)
    return f"{len(chosen)} trainings in {folder}"


def scores(folder: Path, training: Training, seeds: int) -> dict[str, npt.NDArray[np.float64]]:
    """Rewards and failures [S, E] of a dose on all held-out traffics; empty where none is made."""
    rewards, failures = [], []
    for seed in range(seeds):
        path = folder / training._replace(seed=seed).file
        if path.is_file():
            table = pl.read_parquet(path).sort("traffic", "episode")
            rewards.append(table["reward"].to_numpy())
            failures.append(1000.0 * table["failed"].to_numpy())
    if not rewards:
        return {}
    return {"reward": np.array(rewards), "failures": np.array(failures, np.float64)}


def dose_table(folder: Path, seeds: int) -> str:
    """The table of all doses that were tried.

    Raises:
        UserError: there are no trainings among unchanged drivers to compare with.
    """
    rows = []
    for mask in MASKS:
        baseline = scores(folder, Training(mask, UNCHANGED, None, 0), seeds)
        if not baseline:
            continue
        mean, rate = baseline["reward"].mean(), baseline["failures"].mean()
        rows.append(
            [mask, UNCHANGED, "", str(len(baseline["reward"])), f"{mean:.1f}", f"{rate:.1f}"]
        )
        for name, doses in DOSES.items():
            for dose in doses:
                changed = scores(folder, Training(mask, name, dose, 0), seeds)
                if not changed:
                    continue
                cells = []
                for score in ("reward", "failures"):
                    row = entries(score, difference(changed[score], baseline[score]))
                    cells.append(with_interval(row, score, 1))
                rows.append([mask, name, str(dose), str(len(changed["reward"])), *cells])
    if not rows:
        raise UserError(f"--folder {folder}: no finished trainings; run 'train' first.")
    heads = ["mask", "property", "dose", "trainings", "reward", "failures/1000 episodes"]
    return Table("", heads, rows, names=3).text()


def measure(arguments: argparse.Namespace) -> str:
    """Either of the two."""
    if arguments.action == "table":
        return dose_table(arguments.folder, arguments.seeds)
    part, parts = arguments.part
    return train(arguments.folder, arguments.seeds, part, parts)


def part_of_many(text: str) -> tuple[int, int]:
    """``0/2`` is the first of two parts."""
    part, parts = (int(number) for number in text.split("/"))
    if not 0 <= part < parts:
        raise ValueError
    return part, parts


def main(arguments: Sequence[str] | None = None) -> int:
    """The script."""
    parser = make_parser(__doc__)
    parser.add_argument("action", choices=("train", "table"))
    parser.add_argument("--folder", type=Path, default=Path("outputs/dose"))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument(
        "--part",
        type=part_of_many,
        default=(0, 1),
        help="which part of how many, counted from 0: 0/2",
    )
    return run_script(measure, parser.parse_args(arguments))


if __name__ == "__main__":
    sys.exit(main())
