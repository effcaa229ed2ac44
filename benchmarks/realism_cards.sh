#!/bin/sh
# The realism cards of docs/generators.md into outputs/cards, and the figures into docs/figures. Run it from the repository's
# root, with the recordings in GANLANE_DATA or ../shared/data; about nine minutes on one core of a busy machine.
#
#     sh benchmarks/realism_cards.sh
set -eu
export OMP_NUM_THREADS=1
python="${PYTHON:-python}"
rivals='against=[gan,idm_mobil,idm,idm_faults]'

"$python" -m ganlane realism traffic=gan_calibrated "$rivals" scenes=all long_against=true \
    hydra.run.dir=outputs/cards/all
for figure in distributions distances; do
    cp "outputs/cards/all/$figure.png" "docs/figures/realism_$figure.png"
done
"$python" -m benchmarks.figures
