"""``ganlane prepare``: recordings of any kind into one schema, as Parquet, with a report of what
they show.

    ganlane prepare data=scenes data.path=recordings.csv
    ganlane prepare data=ngsim data.path=trajectories-0750am-0805am.txt out=us101
    ganlane prepare data=ngsim data.path=ngsim.csv data.download=true scene_s=30
    ganlane prepare data=highd data.path=highD/data
    ganlane train_generator data.path=us101

Writes one Parquet file per recording, report.md, report.png and results.json.
"""

import sys
from functools import partial

from ganlane.config.app import run_command

#: Entry point; takes the arguments of the command line, and returns the exit status.
main = partial(run_command, "prepare")


if __name__ == "__main__":
    sys.exit(main())
