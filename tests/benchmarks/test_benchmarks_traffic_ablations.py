"""The table of what each option of the generated traffics does, on seconds of driving."""

import json
from pathlib import Path

import pytest
import torch

from benchmarks.ablation_variants import PlanningGenerator, calibrated_variants, gan_variants
from benchmarks.traffic_ablations import BEGIN, END, main
from ganlane.generator import load_generator, shipped_generator
from ganlane.generator.networks import Observation

TINY = ["--vehicle-km", "0.05", "--vehicles", "3", "--batch", "2", "--seconds", "3"]


def observation(generator, rows=2, vehicles=4):
    """Vehicles 12 m apart in two lanes that drive 1.2 to 1.5 m a step."""
    speeds = torch.linspace(1.2, 1.5, vehicles).expand(rows, vehicles)
    past = torch.stack([speeds, torch.zeros_like(speeds)], -1)[:, :, None, :].repeat(
        1, 1, generator.sizes.observed, 1
    )
    x = 1000.0 + 12.0 * torch.arange(vehicles)
    y = 4.0 * (torch.arange(vehicles) % 2)
    position = torch.stack([x, y], -1).expand(rows, vehicles, 2)
    return generator.observe(past, position, torch.ones(rows, vehicles, dtype=torch.bool))


def run(tmp_path, *more):
    return main([*TINY, "--folder", str(tmp_path / "kept"), *more])


def test_a_variant_that_was_driven_with_these_settings_is_not_driven_again(tmp_path, capsys):
    only = ["--only", "gan_calibrated as it is"]
    assert run(tmp_path, *only) == 0
    (kept,) = (tmp_path / "kept").iterdir()
    content = json.loads(kept.read_text())
    assert 0.05 <= content["numbers"]["vehicle_km"] < 1.0
    content["numbers"]["mean_speed_mps"] = 77.7
    kept.write_text(json.dumps(content))
    capsys.readouterr()
    assert run(tmp_path, *only) == 0
    assert "77.7" in capsys.readouterr().out
    assert run(tmp_path, *only, "--seed", "1") == 0
    assert "77.7" not in capsys.readouterr().out


def test_the_table_stands_between_the_markers_with_its_command(tmp_path):
    document = tmp_path / "traffic.md"
    document.write_text(f"{BEGIN}\nwhat stood here\n{END}\n")
    assert run(tmp_path, "--only", "gan without the guard", "--report", str(document)) == 0
    text = document.read_text()
    assert "what stood here" not in text
    assert "| `gan`, without the guard | " in text
    assert "python -m benchmarks.traffic_ablations --vehicle-km 0.05" in text
    assert str(document) not in text


def test_weights_without_a_label_end_in_a_sentence(tmp_path, capsys):
    assert run(tmp_path, "--fitted", "weights.safetensors") == 2
    assert "LABEL=FILE" in capsys.readouterr().err


def test_several_fits_give_mean_lowest_and_highest_and_sums_of_counts(tmp_path, capsys):
    only = ["--only", "gan_calibrated as it is"]
    fits = [tmp_path / f"fit_{seed}.safetensors" for seed in (1, 2)]
    for fit in fits:
        fit.write_bytes(Path(shipped_generator("calibrated")).read_bytes())
    assert run(tmp_path, *only, "--fits", *map(str, [*fits, shipped_generator("paper")])) == 0
    kept = sorted((tmp_path / "kept").iterdir())
    assert len(kept) == 3  # the shipped weights and the two of this preset
    for path, speed, km in zip(kept, (9.0, 12.0, 18.0), (0.2, 1.0, 2.0)):
        content = json.loads(path.read_text())
        content["numbers"].update(mean_speed_mps=speed, vehicle_km=km, off_road=2)
        path.write_text(json.dumps(content))
    capsys.readouterr()
    assert run(tmp_path, *only, "--fits", *map(str, fits)) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if "as it is" in line)
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert (cells[1], cells[4], cells[5]) == ("3", "6", "13.0 [9.0, 18.0]")


def test_other_weights_of_the_same_name_are_driven_too(tmp_path, capsys):
    only = ["--only", "gan_calibrated as it is"]
    for folder in ("one", "other"):
        fit = tmp_path / folder / "fit.safetensors"
        fit.parent.mkdir()
        fit.write_bytes(Path(shipped_generator("calibrated")).read_bytes())
        capsys.readouterr()
        assert run(tmp_path, *only, "--fits", str(fit)) == 0
        assert "gan_calibrated_as_it_is_fit: " in capsys.readouterr().err  # driven, not found


def test_every_variant_has_a_name_and_a_file_of_its_own():
    every = [*gan_variants(), *calibrated_variants()]
    assert len({variant.slug for variant in every}) == len(every)


@pytest.mark.parametrize("steps", [1, 3])
def test_a_plan_is_what_the_generator_predicts_in_one_go(steps):
    generator, _ = load_generator(shipped_generator("paper"))
    planner, seen = PlanningGenerator(generator, steps), observation(generator)
    noise = torch.zeros(2, 4, generator.sizes.noise)
    expected = generator.decode(generator.summarise(seen), noise, seen, steps)
    # What is seen later does not matter while the plan lasts.
    later = Observation(seen.projections, 2.0 * seen.displacement, *seen[2:])
    for step in range(steps):
        now = seen if step == 0 else later
        found = planner.decode(planner.summarise(now), noise, now, 1)
        torch.testing.assert_close(found[..., 0, :], expected[..., step, :])
    assert not torch.allclose(
        planner.decode(planner.summarise(later), noise, later, 1)[..., 0, :], found[..., 0, :]
    )
