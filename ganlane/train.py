"""``ganlane train``: train an agent on a traffic, then evaluate it beside others on the same episodes.

    ganlane train traffic=gan init=idm_ckpt
    ganlane train traffic=idm_mobil init=none total_decisions=2000000 seed=1
    ganlane train experiment=paper
    ganlane train resume=outputs/train/RUN          (or resume=auto)
    ganlane train -m seed=0,1 traffic=idm,gan
    ganlane train traffic=idm traffic._target_=my.module.MyTraffic

Ctrl-C (or SIGTERM) saves and ends; resume goes on from there, and after a kill -9 from the last checkpoint.
Writes agent.safetensors, metrics.csv, config.yaml, results.json and episodes.parquet into its run folder.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from ganlane.config.app import Stopped, run_command
from ganlane.config.train import TrainConfig

#: Name of the agent of this run in the table.
TRAINED = "trained"


def train(config: TrainConfig, folder: Path) -> str:
    """Run the phases, then evaluate what came out."""
    from ganlane.build import make_driver, make_traffic
    from ganlane.compare import compare, publish
    from ganlane.phases import AGENT_FILE, check_finished, checkpoint_of, length_of, phases_of, run_phase
    from ganlane.runtime import set_threads

    set_threads(config.threads)
    for traffic in config.all_traffic():  # a mistake in any of them shows before hours of training, not after
        make_traffic(traffic, config.env)
    others = [make_driver(name, config.env, device=config.device) for name in config.evaluation.agents]
    outcome: dict[str, dict[str, float]] = {}
    training = config.compiled()
    for phase in phases_of(config, folder):
        if phase.name == "pretrain" and (phase.folder / AGENT_FILE).is_file():
            check_finished(config, phase)
            outcome[phase.name] = length_of(phase.folder / AGENT_FILE)
            continue
        result = run_phase(training, phase, checkpoint_of(phase, config.resume))
        if result.stopped_by is not None:
            print(f"saved; go on with: ganlane train resume={folder}", file=sys.stderr)
            raise Stopped(result.stopped_by)
        outcome[phase.name] = {"decisions": result.decisions, "updates": result.updates, "wall_s": result.wall_s}
    trained = replace(make_driver(str(folder / AGENT_FILE), config.env, device=config.device), name=TRAINED)
    table = compare(
        [trained, *others],
        config.evaluation_traffic(),
        config.env,
        config.reward,
        config.observation,
        config.evaluation.episodes,
        config.seed,
        config.evaluation.num_envs,
        config.device,
    )
    seeds = {"training": config.seed, "stream": "report", "episodes": [0, config.evaluation.episodes - 1]}
    numbers = {**outcome["train"], "phases": outcome, "agent": str(folder / AGENT_FILE)}
    return publish(table, folder, asdict(config), seeds, numbers)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    return run_command("train", train, arguments)


if __name__ == "__main__":
    sys.exit(main())
