"""Does everything still give what it gave, bit for bit? For changes that should change nothing.

    python -m benchmarks.nets make digests.json       # before the change
    python -m benchmarks.nets compare digests.json    # after it: what differs; status 1 if anything

Digests of rollouts of every traffic, scenario, observation, reward and mask, of the weights of
three tiny trainings, and of all episodes of an evaluation. They depend on the machine and on the
version of torch: keep the file outside the repository. It takes minutes on one core.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file

from benchmarks.script import ROOT, make_parser, run_script
from ganlane import api, keys
from ganlane.errors import UserError
from ganlane.evaluation.table import Table
from ganlane.files import write_json

ROWS = 64
DECISIONS = 20
#: What only some machines have, or needs a file.
LEFT_OUT = {"traffic": ("sumo", "highway_env", "replay", "none"), "env": ("scene",)}
DRIVERS = ("mobil", "mobil_egoistic", "keep_lane", "random_legal", "random", "agent_idm")
TINY = {
    "total_decisions": 640,
    "log_every": 320,
    "num_envs": 16,
    "threads": 1,
    "agent": {"batch_size": 32, "warmup": 64, "capacity": 1000, "learning_rate_decisions": 640},
    "evaluation": {"agents": ["mobil", "random_legal"], "episodes": 4},
}


def digest(*values: Any) -> str:
    """The sha256 of tensors, with their types and shapes, and of words."""
    sha = hashlib.sha256()
    for value in values:
        if isinstance(value, torch.Tensor):
            sha.update(f"{value.dtype} {tuple(value.shape)}".encode())
            sha.update(value.detach().contiguous().numpy().tobytes())
        else:
            sha.update(repr(value).encode())
    return sha.hexdigest()


def rollout(**options: Any) -> dict[str, str]:
    """Digests of what a rollout holds, by key; one row in eight is steered off the road."""
    env = api.make_env(num_envs=ROWS, **options)
    row = torch.arange(ROWS)
    courses: dict[str, list[torch.Tensor]] = {}
    state = env.reset()
    for decision in range(DECISIONS):
        drawn = (7 * row + 3 * decision + row * decision) % 11
        action = torch.where(row % 8 == 0, drawn % 3, (drawn == 0) + 2 * (drawn == 1))
        stepped, state = env.step_and_maybe_reset(state.set(keys.ACTION, action))
        for name, leaf in stepped["next"].items(include_nested=True, leaves_only=True):
            courses.setdefault(str(name), []).append(leaf.clone())
    return {name: digest(*leaves) for name, leaves in courses.items()}


def rollouts() -> Iterator[tuple[str, str]]:
    """Of every option of the environment, the others as they are by default."""
    for option in ("traffic", "env", "observation", "reward", "mask"):
        for path in sorted((ROOT / "conf" / option).glob("*.yaml")):
            if path.stem in LEFT_OUT.get(option, ()):
                continue
            for name, value in rollout(**{"mask": "safe", option: path.stem}).items():
                yield f"{option}={path.stem} {name}", value


def trainings(folder: Path) -> Iterator[tuple[str, str]]:
    """From scratch, the same run gone on with, and warm-started from a shipped agent."""
    weights = folder / "scratch" / "agent.safetensors"
    api.train("idm", "none", folder=weights.parent, **TINY)
    yield "trained from scratch", digest(*load_file(weights).values())
    api.train(folder=weights.parent, resume=True, total_decisions=960)
    yield "resumed", digest(*load_file(weights).values())
    api.train("gan_calibrated", "idm_ckpt", folder=folder / "warm", **TINY)
    yield "warm-started", digest(*load_file(folder / "warm" / weights.name).values())


def digests() -> dict[str, str]:
    """All of them, by name."""
    torch.set_num_threads(1)
    by_name = dict(rollouts())
    with tempfile.TemporaryDirectory() as folder:
        by_name |= dict(trainings(Path(folder)))
    episodes = api.evaluate(DRIVERS, ["idm_mobil", "gan_calibrated"], 64, per_episode=True)
    for (driver, traffic), rows in episodes.group_by("agent", "traffic", maintain_order=True):
        by_name[f"{driver} on {traffic}"] = digest(rows.rows())
    return by_name


def compare(before: dict[str, str], after: dict[str, str]) -> str:
    """What differs, a line each.

    Raises:
        UserError: something does.
    """
    lines = [[name, "gone"] for name in before if name not in after]
    for name, value in after.items():
        if before.get(name) != value:
            lines.append([name, "differs" if name in before else "new"])
    if lines:
        table = Table("", ["what", "verdict"], lines, names=2)
        raise UserError(f"{len(lines)} of {len(after)} digests are others:\n{table.text()}")
    return f"all {len(after)} digests are equal"


def run(arguments: argparse.Namespace) -> str:
    """Write the file, or compare with it."""
    if arguments.task == "make":
        write_json(arguments.file, digests())
        return f"digests: {arguments.file}"
    if not arguments.file.is_file():
        raise UserError(f"{arguments.file}: no such file; run 'make' before the change.")
    return compare(json.loads(arguments.file.read_text(encoding="utf-8")), digests())


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("task", choices=("make", "compare"))
    parser.add_argument("file", type=Path)
    sys.exit(run_script(run, parser.parse_args()))
