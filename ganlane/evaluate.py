"""``ganlane evaluate``: agents x traffics on the same episodes, as one table.

    ganlane evaluate 'agents=[mobil,random_legal,agent_idm]' 'traffics=[idm_mobil,gan]' episodes=1000
    ganlane evaluate 'agents=[mobil,random_legal,outputs/train/RUN/agent.safetensors]' seed=1
    ganlane evaluate 'agents=[mobil,random_legal,my.module.MyPolicy]' 'traffics=[my.module.MyTraffic]'

Writes results.json and episodes.parquet (one row per episode) into its run folder.
"""

from __future__ import annotations

import sys
from dataclasses import asdict
from functools import partial
from pathlib import Path

from ganlane.config.app import run_command
from ganlane.config.evaluate import EvaluateConfig


def evaluate(config: EvaluateConfig, folder: Path) -> str:
    """Run, print and keep the table."""
    from ganlane.build import make_drivers
    from ganlane.compare import compare, publish
    from ganlane.runtime import set_threads

    set_threads(config.threads)
    drivers = make_drivers(config.agents, config.env, config.device)
    table = compare(drivers, config)
    seeds = {"stream": config.stream, "seed": config.seed, "episodes": [0, config.episodes - 1]}
    return publish(table, folder, asdict(config), seeds)


#: Entry point; takes the arguments of the command line, and returns the exit status.
main = partial(run_command, "evaluate", evaluate)


if __name__ == "__main__":
    sys.exit(main())
