"""``ganlane train``: train an agent on a traffic, then compare it with other drivers.

    ganlane train traffic=gan init=idm_ckpt
    ganlane train traffic=idm_mobil init=none total_decisions=2000000 seed=1
    ganlane train experiment=paper
    ganlane train resume=outputs/train/RUN          (or resume=auto)
    ganlane train -m seed=0,1 traffic=idm,gan
    ganlane train traffic=idm traffic._target_=my.module.MyTraffic

Ctrl-C (or SIGTERM) saves and ends; resume continues from there, and after a kill -9 from the last
checkpoint. Writes agent.safetensors, metrics.csv, config.yaml, results.json and episodes.parquet
into its run folder.
"""

import sys

from ganlane.config.run import run_command

if __name__ == "__main__":
    sys.exit(run_command("train"))
