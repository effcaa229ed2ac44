"""Does everything still give what it gave? Digests of rollouts, trainings, evaluations and cards,
before and after.

    python benchmarks/nets.py make FOLDER               # before a change
    python benchmarks/nets.py compare FOLDER            # after it: one table, exit status 1 where
    something differs python benchmarks/nets.py make FOLDER --episodes 200
    python benchmarks/nets.py compare FOLDER --only rollout

``FOLDER`` belongs outside the repository, since digests depend on the machine and the version of
torch. Recorded are:

- ``rollout``: 64 rows, 100 decisions of a fixed sequence of actions in every traffic (``replay``
  where recordings are found), and 20 decisions in every scenario, observation, reward and mask;
- ``training``: the final weights of three tiny runs on one thread (from scratch, resumed,
  warm-started);
- ``evaluation``: every row of a table with all rule-based drivers and the agents that ship;
- ``realism``: the numbers of a quick card;
- ``load``: weights and decisions of the agents that ship.

A digest is a sha256 of the values, bit for bit. Names may change: a group is equal when its digests
are the same set.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from tensordict import TensorDictBase
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
TRAFFICS = (
    "idm",
    "idm_mobil",
    "idm_random",
    "idm_faults",
    "gan",
    "gan_calibrated",
    "mixed",
    "replay",
)
AGENTS = (
    "mobil",
    "mobil_egoistic",
    "keep_lane",
    "random_legal",
    "random",
    "agent_idm",
    "agent_gan",
)
SHIPPED_AGENTS = ("agent_idm", "agent_gan")
ROWS, DECISIONS, SHORT = 64, 100, 20
#: Keys of the state that are compared, by group; a nested key takes all of its leaves.
GROUPS = {
    "vehicles": ("vehicles",),
    "rewards": ("reward", "reward_terms"),
    "events": ("events", "terminated", "truncated", "done"),
    "observation": ("observation",),
    "action_mask": ("action_mask",),
}
SHORT_RUN = [
    "total_decisions=640",
    "log_every=320",
    "num_envs=16",
    "agent.batch_size=32",
    "agent.warmup=64",
    "agent.capacity=1000",
    "evaluation.agents=[mobil,random_legal]",
    "evaluation.episodes=4",
]
FROM_SCRATCH = [*SHORT_RUN, "env.goal_m=40", "init=none", "agent.hidden=[16,16]", "traffic=idm"]
FROM_SCRATCH += ["agent.learning_rate_decisions=640"]  # prolonged below
TWO_PHASES = ["traffic@pretrain.traffic=idm_mobil", "pretrain.total_decisions=320"]
WARM_STARTED = [*SHORT_RUN, "traffic=gan_calibrated", "init=idm_ckpt"]

#: Digest or value by name, of one group.
Group = dict[str, str]


def digest(values: Tensor | list[Tensor]) -> str:
    """The sha256 of tensors, with their types and shapes."""
    sha = hashlib.sha256()
    for tensor in values if isinstance(values, list) else [values]:
        sha.update(f"{tensor.dtype} {tuple(tensor.shape)}".encode())
        sha.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return sha.hexdigest()


def scripted_actions(decision: int, rows: int) -> Tensor:
    """The actions [rows] of a decision: keep mostly, left and right now and then."""
    row = torch.arange(rows)
    drawn = (7 * row + 3 * decision + row * decision) % 11
    return (drawn == 0).long() + 2 * (drawn == 1).long()


def leaves_of(state: TensorDictBase, names: tuple[str, ...]) -> dict[str, Tensor]:
    """The tensors under ``names`` in ``state``, by dotted name."""
    leaves: dict[str, Tensor] = {}
    for name in names:
        value = state.get(name, None)
        if isinstance(value, Tensor):
            leaves[name] = value
        elif value is not None:
            inner = value.items(include_nested=True, leaves_only=True)
            leaves |= {
                ".".join([name, *([key] if isinstance(key, str) else key)]): leaf
                for key, leaf in inner
            }
    return leaves


def roll_out(decisions: int, **options: Any) -> dict[str, Group]:
    """Digests of an environment under the scripted actions, by group.

    Every eighth row gives commands that the mask forbids, so that leaving the road is seen too.
    """
    import ganlane

    env = ganlane.make_env(num_envs=ROWS, **({"mask": "safe"} | options))
    disobedient = torch.arange(ROWS) % 8 == 0
    courses: dict[str, dict[str, list[Tensor]]] = {name: {} for name in GROUPS}
    state = env.reset()
    for decision in range(decisions):
        action = scripted_actions(decision, ROWS)
        mask = state.get("action_mask", None)
        if mask is not None:
            allowed = mask.gather(1, action[:, None]).squeeze(1)
            action = torch.where(allowed | disobedient, action, 0)
        after, following = env.step_and_maybe_reset(state.set("action", action))
        for group, names in GROUPS.items():
            for name, leaf in leaves_of(after["next"], names).items():
                courses[group].setdefault(name, []).append(leaf.clone())
        state = following
    return {
        group: {name: digest(leaves) for name, leaves in course.items()}
        for group, course in courses.items()
        if course
    }


def rollouts(arguments: argparse.Namespace, work: Path) -> Iterator[tuple[str, Group]]:
    """Every traffic for long; every other option for a short while."""
    from ganlane.errors import UserError

    def options_of(folder: str) -> list[str]:
        return sorted(path.stem for path in (ROOT / "conf" / folder).glob("*.yaml"))

    for traffic in TRAFFICS:
        try:
            groups = roll_out(DECISIONS, traffic=traffic)
        except UserError as error:
            if traffic != "replay":
                raise
            print(f"replay is left out: {error}", file=sys.stderr)
            continue
        yield from ((f"traffic {traffic}, {group}", digests) for group, digests in groups.items())
    kinds: list[tuple[str, str, dict[str, Any]]] = [
        *(("env", name, {"env": name}) for name in options_of("env") if name != "scene"),
        *(("observation", name, {"observation": name}) for name in options_of("observation")),
        *(("reward", name, {"reward": name}) for name in options_of("reward")),
        *(("mask", name, {"mask": name}) for name in options_of("mask")),
        ("option", "recycle", {"recycle": True}),
        ("option", "abort_lane_change", {"ego": {"abort_lane_change": True}}),
        ("option", "4 lanes, 15 vehicles", {"lanes": 4, "vehicles": 15}),
    ]
    for kind, name, options in kinds:
        for group, digests in roll_out(SHORT, **({"traffic": "idm_mobil"} | options)).items():
            yield f"{kind} {name}, {group}", digests


def run_command(command: str, folder: Path | None, *arguments: str) -> None:
    """``python -m ganlane.COMMAND`` on one thread, into ``folder``; its failure ends the script."""
    home = [] if folder is None else [f"hydra.run.dir={folder}"]
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
    }
    line = [sys.executable, "-m", "ganlane", command, *arguments, *home]
    done = subprocess.run(line, cwd=ROOT, env=environment, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(line)} failed:\n{done.stderr[-2000:]}")


def weights_of(path: Path) -> Group:
    """The digest of every tensor in a file of weights."""
    return {name: digest(tensor) for name, tensor in load_file(path).items()}


def values_of(value: Any, name: str = "") -> Group:
    """Every number and word of parsed JSON by its path, floats with all of their digits."""
    inner: list[tuple[Any, Any]]
    if isinstance(value, dict):
        inner = list(value.items())
    elif isinstance(value, list):
        inner = list(enumerate(value))
    else:
        return {name.removeprefix("."): repr(value)}
    return {
        path: text for key, item in inner for path, text in values_of(item, f"{name}.{key}").items()
    }


def results_in(folder: Path) -> dict[str, Any]:
    """The ``results.json`` of a run."""
    return json.loads((folder / "results.json").read_text(encoding="utf-8"))


def trainings(arguments: argparse.Namespace, work: Path) -> Iterator[tuple[str, Group]]:
    """Tiny runs.

    From scratch with a first phase, the same gone on with, and warm-started from a shipped agent.
    """
    scratch, warm = work / "scratch", work / "warm"
    run_command("train", scratch, *FROM_SCRATCH, *TWO_PHASES)
    yield "from scratch, weights", weights_of(scratch / "agent.safetensors")
    yield "from scratch, evaluation", values_of(results_in(scratch)["rows"])
    run_command("train", None, f"resume={scratch}", "total_decisions=960")
    yield "resumed, weights", weights_of(scratch / "agent.safetensors")
    run_command("train", warm, *WARM_STARTED)
    yield "warm-started, weights", weights_of(warm / "agent.safetensors")


def evaluations(arguments: argparse.Namespace, work: Path) -> Iterator[tuple[str, Group]]:
    """One table of all drivers on two traffics, a row each."""
    folder = work / "evaluation"
    names = (f"agents=[{','.join(AGENTS)}]", "traffics=[idm_mobil,gan_calibrated]")
    run_command("evaluate", folder, *names, f"episodes={arguments.episodes}")
    for row in results_in(folder)["rows"]:
        yield f"{row['agent']} on {row['traffic']}, {arguments.episodes} episodes", values_of(row)


def cards(arguments: argparse.Namespace, work: Path) -> Iterator[tuple[str, Group]]:
    """The quick realism card of the calibrated traffic, its parts one by one."""
    folder = work / "realism"
    run_command("realism", folder, "quick=true", "traffic=gan_calibrated")
    results = results_in(folder)
    for name in ("quantities", "quantities_held_out", "driving", "long_runs"):
        yield f"quick card, {name}", values_of(results[name])


def loaders(arguments: argparse.Namespace, work: Path) -> Iterator[tuple[str, Group]]:
    """The agents that ship: their weights, and what they decide."""
    import ganlane

    for name in SHIPPED_AGENTS:
        agent = ganlane.load_agent(name)
        state = agent.policy.state_dict()
        # The noise of noisy layers is drawn when they are made, and is no weight.
        yield (
            f"{name}, weights",
            {key: digest(value) for key, value in state.items() if "epsilon" not in key},
        )
        form = agent.observation.name if hasattr(agent.observation, "name") else "lane_view_overlap"
        env = ganlane.make_env(
            traffic="idm_mobil", num_envs=ROWS, observation=form, stream="report"
        )
        actions = env.rollout(SHORT, agent.policy, break_when_any_done=False)["action"]
        yield f"{name}, decisions", {"action": digest(actions)}


#: What is recorded, by section.
SECTIONS: dict[str, Callable[[argparse.Namespace, Path], Iterator[tuple[str, Group]]]] = {
    "load": loaders,
    "rollout": rollouts,
    "training": trainings,
    "evaluation": evaluations,
    "realism": cards,
}


def record(arguments: argparse.Namespace, section: str) -> dict[str, Group]:
    """The digests of a section, by name."""
    with tempfile.TemporaryDirectory() as work:
        groups = {}
        for name, group in SECTIONS[section](arguments, Path(work)):
            print(f"{section}: {name}", file=sys.stderr, flush=True)
            groups[name] = group
        return groups


def verdict(before: Group | None, after: Group | None) -> str:
    """``equal``, or what differs."""
    if before is None:
        return "new"
    if after is None:
        return "GONE"
    if sorted(before.values()) == sorted(after.values()):
        return "equal"
    names = sorted(name for name in {*before, *after} if before.get(name) != after.get(name))
    return f"DIFFERS: {', '.join(names[:4])}" + (
        f" and {len(names) - 4} more" if len(names) > 4 else ""
    )


def make(arguments: argparse.Namespace, section: str, path: Path) -> list[tuple[str, str]]:
    """Record a section into its file."""
    groups = record(arguments, section)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(groups, indent=1) + "\n", encoding="utf-8")
    return [(f"{section}: {name}", f"{len(group)} digests") for name, group in groups.items()]


def compare(arguments: argparse.Namespace, section: str, path: Path) -> list[tuple[str, str]]:
    """Record a section again and hold it against its file."""
    if not path.is_file():
        sys.exit(f"{path}: no such file; run `make {arguments.folder}` before the change.")
    before, after = json.loads(path.read_text(encoding="utf-8")), record(arguments, section)
    names = [*before, *(name for name in after if name not in before)]
    return [(f"{section}: {name}", verdict(before.get(name), after.get(name))) for name in names]


def main() -> int:
    """Record or compare; 1 where something differs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task", choices=("make", "compare"))
    parser.add_argument("folder", type=Path, help="where the digests are, outside the repository")
    parser.add_argument(
        "--episodes", type=int, default=64, help="of the evaluation; the same in both tasks"
    )
    parser.add_argument("--only", nargs="+", choices=list(SECTIONS), default=list(SECTIONS))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    lines: list[tuple[str, str]] = []
    for section in arguments.only:
        lines += (make if arguments.task == "make" else compare)(
            arguments, section, arguments.folder / f"{section}.json"
        )
    width = max(len(name) for name, _ in lines)
    print(*(f"{name.ljust(width)}  {result}" for name, result in lines), sep="\n")
    differing = [name for name, result in lines if result.startswith(("DIFFERS", "GONE"))]
    print(f"{len(lines)} compared or recorded, {len(differing)} differ")
    return 1 if differing else 0


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(main())
