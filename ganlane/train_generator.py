"""``ganlane train_generator``: fit a generator to recorded traffic and measure it on scenes it was
not fitted to.

    ganlane train_generator data=scenes data.path=recordings.csv
    ganlane train_generator generator=calibrated data.path=recordings.csv seed=1
    ganlane train_generator data=ngsim data.path=ngsim.csv
    ganlane train_generator data=highd data.path=highD/data
    ganlane train_generator generator=paper data=scenes folds=5
    ganlane evaluate 'traffics=[gan]'
    generator.path=outputs/train_generator/RUN/generator_paper.safetensors

Writes generator_PRESET.safetensors (weights, metrics, lane-change statistics) and results.json into
its run folder. With folds=5 five more generators are fitted, each without the scenes of its fold,
and saved next to it as generator_PRESET_fold_1.safetensors and so on; results.json pools their
errors on these scenes. With ablations=true the preset is also fitted with one part changed at a
time. resume=FOLDER continues the fits of an earlier run.
"""

import sys
from functools import partial

from ganlane.config.app import run_command

#: Entry point; takes the arguments of the command line, and returns the exit status.
main = partial(run_command, "train_generator")


if __name__ == "__main__":
    sys.exit(main())
