"""Trained agents of one recipe, which differ in their seed alone, in one file.

    python -m benchmarks.pack_seeds outputs/paper_1/pretrain outputs/paper_2/pretrain \
        --out ganlane/checkpoints/seeds_of_agent_idm.safetensors
    python -m benchmarks.pack_seeds outputs/paper_1 outputs/paper_2 \
        --out ganlane/checkpoints/seeds_of_agent_gan.safetensors

Each folder is a finished training's and holds agent.safetensors; an agent's file may be given as
well, and ``FILE@all`` for all agents of a packed file that others are to join. The agent with seed
1 is then ``agent_idm@1``, or ``FILE@1`` for a file elsewhere.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from benchmarks.script import make_parser, run_script
from ganlane.agents import read_agent
from ganlane.agents.checkpoint import SEVERAL, with_seeds
from ganlane.errors import UserError
from ganlane.weights import save_weights

#: Weights and metadata.
Agent = tuple[dict[str, Tensor], dict[str, Any]]

#: Largest file that is written.
MOST_BYTES = 5_000_000
#: What agents of one recipe have in common; of the environment all but what has no effect on the
#: episodes.
RECIPE = (
    "observation",
    "observation_scale",
    "mask",
    "sensors",
    "env",
    "num_envs",
    "agent",
    "reward",
    "network",
)
WITHOUT_EFFECT = ("compile", "kernel")


def recipe_of(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """What a training was, without its seed and its results."""
    shared = {name: metadata.get(name) for name in RECIPE}
    env = metadata.get("env", {})
    shared["env"] = {key: value for key, value in env.items() if key not in WITHOUT_EFFECT}
    training = metadata["training"]
    return shared | {name: training.get(name) for name in ("phase", "traffic")}


def of_no_machine(start: str | None) -> str | None:
    """What a training started from, without the folders of the machine.

    ``RUN/pretrain/agent.safetensors``.
    """
    return "/".join(Path(start).parts[-3:]) if start and Path(start).is_absolute() else start


def collect(folders: Sequence[str | Path]) -> dict[int, Agent]:
    """The agents by seed; ``folders`` are folders of trainings, agents' files, ``FILE@1`` or
    ``FILE@all``.

    Raises:
        UserError: a folder without an agent, an agent without a seed, a seed that comes twice, or
            two recipes.
    """
    agents: dict[int, Agent] = {}
    recipes: dict[str, dict[str, Any]] = {}
    for path in (name for folder in folders for name in with_seeds(str(folder))):
        if Path(path).is_dir():
            path = f"{path}/agent.safetensors"
        weights, _, metadata = read_agent(path)
        training = metadata.get("training", {})
        seed = training.get("seed")
        if not isinstance(seed, int):
            raise UserError(
                f"{path}: its metadata name no seed; give an agent that 'ganlane train' wrote."
            )
        if seed in agents:
            raise UserError(f"{path}: another run has seed {seed}, too; give each seed once.")
        recipes[path] = recipe_of(metadata)
        first, reference = next(iter(recipes.items()))
        differing = [name for name, value in recipes[path].items() if value != reference[name]]
        if differing:
            raise UserError(
                f"{path}: another recipe than {first} ({', '.join(differing)}); "
                "give runs of one recipe."
            )
        training["init"] = of_no_machine(training.get("init"))
        agents[seed] = weights, metadata
    return dict(sorted(agents.items()))


def pack(options: argparse.Namespace) -> str:
    """Write the agents into one file, ``FILE@SEED`` for each; the line that names it.

    Names of weights begin with the agent's seed. The scales of the noise are kept in half
    precision, everything that a greedy agent computes with as it is.
    """
    if options.out.suffix != ".safetensors":
        raise UserError(f"--out {options.out}: the name must end in .safetensors.")
    agents = collect(options.folders)
    tensors = {
        f"{seed}/{name}": value.half() if name.endswith("_sigma") else value
        for seed, (weights, _) in agents.items()
        for name, value in weights.items()
    }
    size = sum(value.nbytes for value in tensors.values())
    if size > MOST_BYTES:
        raise UserError(
            f"--out {options.out}: {size / 1e6:.1f} MB, above {MOST_BYTES / 1e6:.0f}; "
            "give fewer runs."
        )
    # each agent's metadata by its seed, as text: JSON has no other keys
    described = {str(seed): metadata for seed, (_, metadata) in agents.items()}
    save_weights(options.out, SEVERAL, tensors, {"agents": described})
    return f"{options.out}: seeds {', '.join(map(str, agents))}; {size / 1e6:.1f} MB"


def main(arguments: Sequence[str] | None = None) -> int:
    """Pack; the exit status."""
    parser = make_parser(__doc__)
    parser.add_argument("folders", nargs="+", metavar="RUN_FOLDER")
    parser.add_argument("--out", type=Path, required=True, help="the .safetensors file to write")
    return run_script(pack, parser.parse_args(arguments))


if __name__ == "__main__":
    sys.exit(main())
