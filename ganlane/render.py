"""``ganlane render``: episodes as a film, an HTML player or a table of trajectories; learning
curves of runs.

    ganlane render agent=mobil traffic=idm_mobil episode=3
    ganlane render agent=agent_idm traffic=gan format=mp4 out=film.mp4
    ganlane render 'agents=[mobil,agent_idm]' traffic=gan episode=3 out=player.html
    ganlane render agent=mobil traffic=gan_calibrated 'episodes=[0,1,2]' out=simulated.parquet
    ganlane render crashes=docs/reproduce/crashes.json 'traffics=[gan]' out=crashes.html
    ganlane render run=outputs/train/FIRST,outputs/train/SECOND out=curves.png      (or .svg, .pdf)

The episodes are those of ``ganlane evaluate`` with the same seed.
"""

import sys
from functools import partial

from ganlane.config.app import run_command

#: Entry point; takes the arguments of the command line, and returns the exit status.
main = partial(run_command, "render")


if __name__ == "__main__":
    sys.exit(main())
