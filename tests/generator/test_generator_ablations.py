import math
from dataclasses import asdict, replace

import pytest

from ganlane.data import SyntheticTraffic, synthetic_scenes
from ganlane.fit_report import ablation_table
from ganlane.generator.cross_validation import ablate, variants
from ganlane.generator.fit_calibrated import CalibratedConfig
from ganlane.generator.fit_paper import PaperConfig
from ganlane.generator.loop import LoopConfig
from ganlane.generator.networks import GeneratorSizes

SIZES = GeneratorSizes(embedding=16, hidden=16, pooling=12, pooled=8, context=16, noise=4)
LOOP = LoopConfig(updates=8, evaluate_every=8, warmup=4)


def flat(config) -> dict:
    """Settings and the settings within them."""
    plain = asdict(config)
    parts = {key: part for key, part in plain.items() if isinstance(part, dict)}
    inner = {f"{key}.{name}": value for key, part in parts.items() for name, value in part.items()}
    return {key: value for key, value in plain.items() if key not in parts} | inner


@pytest.mark.parametrize("config", [PaperConfig(), CalibratedConfig()])
def test_every_variant_has_a_quarter_of_the_updates_and_differs_in_its_part_alone(config):
    first, *others = variants(config).items()
    assert flat(first[1])["loop.updates"] == config.loop.updates // 4
    for name, variant in others:
        changed = {key for key, value in flat(variant).items() if value != flat(first[1])[key]}
        assert 1 <= len(changed) <= (3 if name == "variety term alone" else 1), name


def test_ablations_of_the_papers_preset_stand_side_by_side(tmp_path):
    frame = synthetic_scenes(SyntheticTraffic(scenes=3, vehicles=5, seconds=5.0))
    config = PaperConfig(SIZES, loop=LOOP, stride=6, samples=2, batch=4)
    names, updates = [], []
    rows = ablate(frame, config, ("synthetic-1",), tmp_path, names.append, updates.append)
    assert list(rows) == names == list(variants(config))
    assert len(updates) == 2 * len(rows)
    assert rows["p_l = 4"]["windows"] > rows["p_l = 12"]["windows"]
    short = rows["p_l = 4"]
    assert short["ade_change_percent"] == short["ade_change_percent_0.4_s"]
    assert len(ablation_table(rows).splitlines()) == 1 + len(rows)


def test_ablations_of_the_calibrated_preset_are_rolled_out_too(tmp_path):
    frame = synthetic_scenes(SyntheticTraffic(scenes=3, vehicles=4, seconds=6.5))
    sizes = replace(SIZES, extra_inputs=4)
    config = CalibratedConfig(sizes, LOOP, (4,), (1.0,), held_out_horizon=8, batch=2, held_out_stride=20)
    rows = ablate(frame, config, ("synthetic-1",), tmp_path)
    assert variants(config)["without washout"].anchor.washout_s == math.inf
    assert all(math.isfinite(row["rmse_5_s_ratio"]["mean"]) for row in rows.values())
    assert rows["as it is"] != rows["without traits"]
    assert "RMSE 5 s" in ablation_table(rows)
