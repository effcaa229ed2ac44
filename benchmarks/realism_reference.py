"""The histograms of recorded driving that ship, from the recordings that the card finds by itself.

python -m benchmarks.realism_reference
"""

from __future__ import annotations

from dataclasses import replace

from ganlane.data import default_scenes, read_scenes
from ganlane.realism.card import floors_of
from ganlane.realism.driving import StartOptions
from ganlane.realism.measures import SHIPPED_REFERENCE
from ganlane.realism.starts import recorded_starts

if __name__ == "__main__":
    path = default_scenes()
    frame = read_scenes(path)
    scenes = frame["scene"].unique().sort().to_list()
    starts = recorded_starts({}, scenes, (), frame, StartOptions(repeats=4), False, path.name)
    replace(starts.reference, floors=floors_of(starts)).save(SHIPPED_REFERENCE)
    print(f"wrote {SHIPPED_REFERENCE}")
