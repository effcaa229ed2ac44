#!/bin/sh
# The realism cards of docs/generators.md into outputs/cards, and the figures into docs/figures. Run it from the repository's
# root, with the recordings in GANLANE_DATA or ../shared/data; about nine minutes on one core of a busy machine, and
# as long again for the card by folds.
#
#     sh benchmarks/realism_cards.sh
#
# With generators of k folds, one file per preset and fold, a card in which nobody drives where it was fitted is made
# too. "train_generator folds=5" keeps them:
#
#     FOLDS=$(ls outputs/folds/*/generator_*_fold_*.safetensors | paste -sd,) sh benchmarks/realism_cards.sh
set -eu
export OMP_NUM_THREADS=1
python="${PYTHON:-python}"
rivals='against=[gan,idm_mobil,idm,idm_faults,ganlane.realism.driving.HeadwayIdm]'

"$python" -m ganlane realism traffic=gan_calibrated "$rivals" scenes=all long_against=true \
    hydra.run.dir=outputs/cards/all
for figure in distributions distances; do
    cp "outputs/cards/all/$figure.png" "docs/figures/realism_$figure.png"
done
if [ -n "${FOLDS:-}" ]; then
    "$python" -m ganlane realism traffic=gan_calibrated "$rivals" "fold_weights=[$FOLDS]" vehicle_km=0 i80=false \
        hydra.run.dir=outputs/cards/folds
fi
"$python" -m benchmarks.figures --folder docs/figures
