"""The Social-GAN baselines compute what they should, and are compared at their best."""

import pytest
import torch

from benchmarks import social_gan
from benchmarks.social_gan import BASELINES, PaddedGenerator, SceneLoopGenerator, ratios
from ganlane.bench.suites import TRAFFIC
from ganlane.generator import GeneratorSizes

SMALL = GeneratorSizes(embedding=6, hidden=5, pooling=4, pooled=3, context=6, noise=2)


def test_the_tables_of_a_run_go_into_the_document(tmp_path, capsys):
    document = tmp_path / "page.md"
    document.write_text(f"{social_gan.BEGIN}\n{social_gan.END}\n")
    numbers = {"batches": 2, "threads": 1, "repetitions": 2, "seconds": 0.001}
    tiny = [part for name, value in numbers.items() for part in (f"--{name}", str(value))]
    tiny += ["--traffics", "gan", "--modes", "eager"]
    assert social_gan.main([*tiny, "--report", str(document)]) == 0
    text = document.read_text()
    assert "| ganlane traffic | gan | eager | 1 | 2 |" in text
    assert text.count("| Social-GAN | eager |") == len(BASELINES)
    assert "| gan | padded, 8 steps decoded | " in text


@pytest.mark.parametrize("pool_every_step", [True, False])
def test_the_scene_loop_treats_every_scene_as_if_it_were_alone(pool_every_step):
    torch.manual_seed(0)
    network = SceneLoopGenerator(SMALL, pool_every_step)
    network.with_noise = lambda context, ends: torch.cat(
        [context, torch.zeros(len(context), SMALL.noise)], dim=1
    )
    moves, position = torch.randn(8, 5, 2), torch.randn(5, 2)
    together = network(moves, position, [(0, 2), (2, 5)])
    torch.testing.assert_close(together[:, 2:], network(moves[:, 2:], position[2:], [(0, 3)]))
    assert together.shape == (8, 5, 2)


def test_padding_changes_nobodys_pooling():
    torch.manual_seed(0)
    network = PaddedGenerator(SMALL)
    hidden, position = torch.randn(2, 4, 5), torch.randn(2, 4, 2)
    valid = torch.tensor([[True, True, True, False]] * 2)
    pooled = network.pooled(hidden, position, valid)[:, :3]
    torch.testing.assert_close(pooled, network.pooled(hidden[:, :3], position[:, :3], valid[:, :3]))


@pytest.mark.parametrize("name", BASELINES)
def test_a_baseline_moves_every_vehicle_and_counts_its_steps(name):
    torch.manual_seed(0)
    loop = BASELINES[name](3, 4)
    before = loop.position.clone()
    assert loop(2) == 2 * 10 * 3
    assert (loop.position != before).any(-1).all()
    assert torch.isfinite(loop.position).all()


def test_each_counts_at_its_best():
    def row(system, wall, cpu, traffic="Social-GAN"):
        return {
            "system": system,
            "traffic": traffic,
            "physics_steps_per_s": wall,
            "physics_steps_per_cpu_s": cpu,
        }

    rows = [row(TRAFFIC, 900, 400, "gan"), row(TRAFFIC, 600, 600, "gan")]
    rows += [row(name, rate, 10) for name in BASELINES for rate in (20, 30)]
    assert [(found["ratio"], found["ratio_cpu"]) for found in ratios(rows)] == [(30, 60)] * 3
