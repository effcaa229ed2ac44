"""``ganlane record``: a driver's episodes as an offline dataset in Minari's format
(https://minari.farama.org).

    ganlane record agent=mobil traffic=idm_mobil episodes=100 out=datasets
    ganlane record agent=agent_general traffic=gan_calibrated mask=legal dataset=highway/expert-v0
    out=datasets MINARI_DATASETS_PATH=datasets python -c "import minari;
    print(minari.load_dataset('ganlane/idm_mobil/mobil-v0'))"

Observations, actions, rewards, ends and infos are those of gymnasium's ganlane/Highway-v0
(docs/gymnasium.md), which ``recover_environment()`` makes; episode k begins with
``reset(seed=seed, options={"episode": k})``. Needs the extra
'minari'.
"""

import sys
from functools import partial

from ganlane.config.app import run_command

#: Entry point; takes the arguments of the command line, and returns the exit status.
main = partial(run_command, "record")


if __name__ == "__main__":
    sys.exit(main())
