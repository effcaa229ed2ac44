"""Memory per environment and peak memory, in processes of their own."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from tensordict import TensorDict

from ganlane.benchmarks.case import Case, Labels
from ganlane.benchmarks.memory import bytes_of, growth_per_environment, peak_resident_bytes

_FLOATS = 25_000


def hold(batch):
    """Holds 100 kB per environment, and touches all of it."""
    held = torch.ones(batch, _FLOATS)

    def run(decisions):
        held.mul_(1.0)
        return 10 * decisions * batch

    return run


def case(batch):
    labels = Labels("sim", "memory", "mine", "idm", "eager", "float32", "cpu", 1, 9, 3, batch)
    return Case(labels, partial(hold, batch))


def test_the_peak_stays_when_memory_is_given_back():
    before = peak_resident_bytes()
    if before is None:
        pytest.skip("this system does not tell a process's peak memory")
    size = before + 50_000_000
    held = torch.ones(size, dtype=torch.uint8)
    assert peak_resident_bytes() >= size
    del held
    assert peak_resident_bytes() >= size


@pytest.mark.slow
def test_growth_finds_what_an_environment_holds():
    if peak_resident_bytes() is None:
        pytest.skip("this system does not tell a process's peak memory")
    # 40 to 240 MB, of which the rest of the process moves by a few.
    growth = growth_per_environment(case(400), case(2400))
    assert growth == pytest.approx(4 * _FLOATS, rel=0.05)


def test_bytes_are_those_of_all_leaves():
    nested = TensorDict({"a": torch.zeros(2, 3), "b": {"c": torch.zeros(2, dtype=torch.int64)}}, batch_size=[2])
    assert bytes_of(nested) == 2 * 3 * 4 + 2 * 8
