"""Threads of the kernel: they share the rows, and the numbers are those of one thread."""

from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context

import numpy as np
import pytest
from reference import processes
from reference.marks import needs_fork

from ganlane.gym.base import make_rows
from ganlane.native.library import BLOCK, ROWS_PER_THREAD
from ganlane.runtime import kernel_threads

pytestmark = pytest.mark.kernel
ROWS = 3 * ROWS_PER_THREAD + BLOCK + 1
DECISIONS = 30


def course(threads, seed=0):
    """Observations and rewards of all rows, by a number of threads."""
    batch = make_rows("idm_mobil", ROWS, False, (), {})
    batch.start(seed, np.arange(ROWS))
    actions = np.random.default_rng(seed).integers(3, size=(DECISIONS, ROWS))

    def driven():
        kernel_threads.set(threads)
        for action in actions:
            stepped = batch.step(action)
            yield stepped.observation.copy()
            yield stepped.reward.copy()

    return copy_context().run(lambda: list(driven()))


def assert_same(one, other):
    for numbers, expected in zip(one, other, strict=True):
        np.testing.assert_array_equal(numbers, expected)


@pytest.mark.parametrize("threads", [2, 3, 7])
def test_any_number_of_threads_gives_the_numbers_of_one(threads):
    assert_same(course(threads), course(1))


def test_threads_that_drive_at_once_do_not_disturb_each_other():
    expected = [course(1, seed) for seed in range(4)]
    with ThreadPoolExecutor(4) as pool:
        for numbers, wanted in zip(pool.map(lambda seed: course(2, seed), range(4)), expected):
            assert_same(numbers, wanted)


FORKED = """
import os, signal
import numpy as np
import gymnasium, ganlane
from ganlane.runtime import kernel_threads

kernel_threads.set(2)
signal.alarm(60)  # in place of waiting for ever
envs = gymnasium.make_vec("ganlane/Highway-v0", num_envs=512, traffic="idm_mobil").unwrapped
envs.reset(seed=0)
keep = np.zeros(512, int)
envs.step(keep)
child = os.fork()
total = sum(float(envs.step(keep)[1].sum()) for _ in range(20))
if child == 0:
    print(total, flush=True)
    os._exit(0)
assert os.waitpid(child, 0)[1] == 0
print(total)
"""


@needs_fork
def test_a_forked_process_drives_on_with_threads_of_its_own():
    done = processes.run("-W", "ignore", "-c", FORKED)
    assert done.returncode == 0, done.stderr
    childs, parents = done.stdout.split()
    assert childs == parents
