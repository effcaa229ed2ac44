"""What each part of the agent is worth: trained again without it, with several seeds, and compared.

    python -m benchmarks.ablations                        # trains what is missing: about four hours
    on one core python -m benchmarks.ablations --only nothing dqn --seeds 0 1

Everything is trained as ``experiment=ablation`` with the options of :data:`ABLATIONS`, seed after
seed, and its last policy is compared on the same episodes behind the mask of its training, or
behind none. Trainings that are finished are not done again, nor are cells that were driven.
``python -m benchmarks.printed --write`` makes the document's table.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tqdm import tqdm

from benchmarks.pack_seeds import AGENT_FILE, collect
from benchmarks.script import make_parser, run_script
from ganlane.agents.checkpoint import save_agents
from ganlane.compare import available, cells_of, drive, read_cells
from ganlane.config.command_line import check
from ganlane.settings.commands import ReproduceConfig
from ganlane.errors import UserError
from ganlane.evaluation import write_results
from ganlane.reproduce import report

OUT = Path("docs/reproduce/ablations")
RUNS = Path("outputs/ablations")
#: What all others are compared with.
BASE = "nothing"
_WIDER = ("agent.v_min=-150", "agent.v_max=180")
#: What differs from ``experiment=ablation``, by name.
ABLATIONS: Mapping[str, tuple[str, ...]] = {
    BASE: (),
    "without_noisy": ("agent.noisy=false",),
    "without_dueling": ("agent.dueling=false",),
    "without_distributional": ("agent.distributional=false",),
    "without_double": ("agent.double=false",),
    "without_prioritised": ("agent.prioritised=false",),
    "one_step": ("agent.n_step=1",),
    "dqn": ("agent=dqn",),
    "gamma_095": ("agent.gamma=0.95",),
    "gamma_099": ("agent.gamma=0.99", *_WIDER),  # returns add up over more decisions
    "table3": ("observation=table3",),
    "table3_progress": ("observation=table3_progress",),
    "lane_view": ("observation=lane_view",),
    "legal": ("mask=legal",),
    "safe": ("mask=safe",),
    "mixed": (
        "traffic=mixed",
        "traffic.shares={idm:1,idm_mobil:1,idm_random:1}",
        "collector.num_envs=1023",
    ),
    "considerate": ("reward=considerate",),
}
#: Mask that its agents are compared behind, where it is another than none.
BEHIND = {"legal": "legal", "safe": "safe"}
SEEDS = (0, 1, 2)
OPTIONS = ("traffics=[idm_mobil,idm,idm_faults]", "episodes=500", "workers=2")


def train(folder: Path, name: str, seed: int, options: Sequence[str]) -> None:
    """Train one agent in a process of its own.

    Raises:
        UserError: it ended without an agent.
    """
    overrides = [
        "experiment=ablation",
        *ABLATIONS[name],
        f"seed={seed}",
        *options,
        f"hydra.run.dir={folder}",
    ]
    quiet = ["logger.progress=false", "checkpoint_replay=false"]
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "log.txt").open("w", encoding="utf-8") as log:
        done = subprocess.run(
            [sys.executable, "-m", "ganlane.train", *quiet, *overrides], stdout=log, stderr=log
        )
    if done.returncode != 0:
        raise UserError(
            f"{name}, seed {seed}: the training ended with {done.returncode}; see {folder / 'log.txt'}."
        )


def train_all(options: argparse.Namespace) -> dict[str, Path]:
    """Train what is missing; the file of each ablation's agents by name."""
    folders = {
        (name, seed): options.runs / f"{name}_{seed}"
        for seed in options.seeds
        for name in options.only
    }
    missing = {
        place: folder for place, folder in folders.items() if not (folder / AGENT_FILE).is_file()
    }
    for (name, seed), folder in tqdm(
        missing.items(), unit="training", disable=not sys.stderr.isatty()
    ):
        train(folder, name, seed, options.train)
    files = {name: options.runs / f"{name}.safetensors" for name in options.only}
    for name, path in files.items():
        save_agents(path, collect([folders[name, seed] for seed in options.seeds]))
    return files


def compared(
    files: Mapping[str, Path], options: Sequence[str]
) -> tuple[dict[str, Any], ReproduceConfig]:
    """Rows and comparisons with :data:`BASE`, where that is among them, by the names of
    :data:`ABLATIONS`.
    """
    drivers = {name: f"{path}@all+{BEHIND.get(name, 'none')}" for name, path in files.items()}
    config = check(
        "reproduce", [f"agents=[mobil,{','.join(drivers.values())}]", *OPTIONS, *options]
    ).config
    assert isinstance(config, ReproduceConfig)
    cells = cells_of(config, available(config)[0])
    drive(cells, config)
    episodes, revisions, _ = read_cells(cells)
    found = {
        (name.partition("+")[0], traffic): trainings
        for (name, traffic), trainings in report.by_recipe(episodes).items()
    }
    pairs = [(name, BASE) for name in files if name != BASE]
    record = {
        "rows": report.rows(found),
        "comparisons": report.comparisons(found, pairs),
        "revisions": revisions,
        "changed": {name: list(ABLATIONS[name]) for name in files},
    }
    return record, config


def measure(options: argparse.Namespace) -> str:
    """Train and compare; the path of the results."""
    unknown = [name for name in options.only if name not in ABLATIONS]
    if unknown:
        raise UserError(f"--only {unknown[0]}: no such ablation; there are {', '.join(ABLATIONS)}.")
    record, config = compared(train_all(options), options.options)
    record = {
        "command": shlex.join(["python", "-m", "benchmarks.ablations", *options.given]),
        **record,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    seeds = {
        "trainings": list(options.seeds),
        "stream": config.stream,
        "seed": config.seed,
        "episodes": {
            name: config.episodes_on(name)
            for name in dict.fromkeys(row["traffic"] for row in record["rows"])
        },
    }
    return f"results: {write_results(options.out, record, asdict(config), seeds)}"


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = make_parser(__doc__)
    parser.add_argument(
        "options", nargs="*", metavar="KEY=VALUE", help="options of ganlane reproduce"
    )
    parser.add_argument(
        "--train",
        nargs="*",
        default=[],
        metavar="KEY=VALUE",
        help="further options of ganlane train",
    )
    parser.add_argument(
        "--only", nargs="+", default=list(ABLATIONS), metavar="NAME", help="some of the ablations"
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS)
    parser.add_argument("--runs", type=Path, default=RUNS, help=f"folder of the trainings ({RUNS})")
    parser.add_argument("--out", type=Path, default=OUT, help=f"folder of results.json ({OUT})")
    given = list(sys.argv[1:] if arguments is None else arguments)
    return argparse.Namespace(**vars(parser.parse_intermixed_args(given)), given=given)


def main(arguments: Sequence[str] | None = None) -> int:
    """Train and compare; the exit status."""
    return run_script(measure, parse(arguments))


if __name__ == "__main__":
    sys.exit(main())
