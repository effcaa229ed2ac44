#!/bin/sh
# Every traffic's realism card, into docs/realism.md and docs/figures. Run from the repository's root, with the
# recordings in GANLANE_DATA or ../shared/data. About a quarter of an hour on one core.
#
#     sh benchmarks/realism_cards.sh
#
# With generators of k folds (python -m ganlane.train_generator folds=true), name them, one per preset and fold:
#
#     FOLDS="a.safetensors,b.safetensors" sh benchmarks/realism_cards.sh
set -eu
export OMP_NUM_THREADS=1
python="${PYTHON:-python}"
rivals='against=[gan,idm_mobil,idm,ganlane.evaluation.realism_drivers.HeadwayIdm]'
into='report=docs/realism.md'

"$python" -m ganlane.realism traffic=gan_calibrated "$rivals" scenes=held_out vehicle_km=0 i80=false "$into"
"$python" -m ganlane.realism traffic=gan_calibrated "$rivals" scenes=all long_against=true "$into" figures=docs/figures
if [ -n "${FOLDS:-}" ]; then
    "$python" -m ganlane.realism traffic=gan_calibrated "$rivals" scenes=all "fold_weights=[$FOLDS]" vehicle_km=0 \
        i80=false "$into"
fi
"$python" benchmarks/figures.py --folder docs/figures
