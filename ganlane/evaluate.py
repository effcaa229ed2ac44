"""``ganlane evaluate``: agents x traffics on the same episodes, as one table.

    ganlane evaluate 'agents=[mobil,random_legal,agent_idm]' 'traffics=[idm_mobil,gan]'
    episodes=1000 ganlane evaluate 'agents=[mobil,random_legal,outputs/train/RUN/agent.safetensors]'
    seed=1 ganlane evaluate 'agents=[mobil,random_legal,my.module.MyPolicy]'
    'traffics=[my.module.MyTraffic]'

Writes results.json and episodes.parquet (one row per episode) into its run folder.
"""

import sys
from functools import partial

from ganlane.config.app import run_command

#: Entry point; takes the arguments of the command line, and returns the exit status.
main = partial(run_command, "evaluate")


if __name__ == "__main__":
    sys.exit(main())
