"""Train an agent phase by phase, then compare it with other drivers on the same episodes."""

from __future__ import annotations

import sys
from pathlib import Path

from ganlane.build import make_driver, make_drivers, make_traffic
from ganlane.commands.evaluate import publish
from ganlane.config.run import Stopped, earned
from ganlane.errors import UserError
from ganlane.settings.train import TrainConfig
from ganlane.suite.driving import compare
from ganlane.training.checkpoint import LAST
from ganlane.training.phases import AGENT_FILE, length_if_finished, phases_of, run_phase

#: Name of the agent of this run in the table.
TRAINED = "trained"


def train(config: TrainConfig, folder: Path) -> str:
    """Run the phases, then evaluate the trained agent; the line that names the results.

    Raises:
        UserError: a run is in the folder already, or a traffic or driver cannot be made.
        Stopped: a signal has ended the training, which was saved first.
    """
    if config.resume is None and earned(folder):
        raise UserError(
            f"{folder}: a run is there already; go on with resume={folder}, or give another folder."
        )

    # a mistake in any of them shows before hours of training, not after
    for traffic in config.all_traffic():
        make_traffic(traffic, config.env)
    others = make_drivers(config.evaluation.agents, config.env, config.device)

    # decisions, updates and wall time by phase
    lengths: dict[str, dict[str, float]] = {}
    for phase in phases_of(config, folder):
        # a resumed run does not repeat a first phase that is over
        finished = length_if_finished(phase)
        if finished is not None:
            lengths[phase.name] = finished
            continue

        # stopped before its first checkpoint, a phase starts anew
        resume = None
        last = phase.folder / LAST
        if config.resume is not None and last.is_file():
            resume = last
        result = run_phase(phase, resume)
        if result.stopped_by is not None:
            print(f"saved; go on with: ganlane train resume={folder}", file=sys.stderr)
            # the exit status says by which signal
            raise Stopped(result.stopped_by)
        lengths[phase.name] = result.progress

    # from its file, as anybody will load it
    agent = str(folder / AGENT_FILE)
    trained = make_driver(agent, config.env, device=config.device).renamed(TRAINED)
    # the trained agent and the others drive the same episodes
    table = compare([trained, *others], config.final_evaluation())

    seeds = {
        "training": config.seed,
        "stream": "report",
        "episodes": [0, config.evaluation.episodes - 1],
    }
    # those of the phase that every training has stand at the top, too
    numbers = {
        **lengths["train"],
        "phases": lengths,
        "agent": agent,
    }
    return publish(table, folder, config, seeds, numbers)
