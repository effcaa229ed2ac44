"""The native kernel against the tensor code, the scalar twin and itself."""

from __future__ import annotations

import random

import pytest
import torch
from native_highways import (
    MOTION,
    actions,
    by_kernel,
    differing_rows,
    disturbed,
    errors,
    kernel_of,
    random_highway,
    within_rounding,
)
from reference import scalar
from reference.worlds import environment, rules_of, scalar_state

from ganlane import keys
from ganlane.errors import UserError
from ganlane.native.library import VARIANTS, best_variant, why_not
from ganlane.native.tensors import Kernel, Outcome, moved
from ganlane.sim.state import Road, Vehicles

pytestmark = pytest.mark.skipif(why_not() is not None, reason=f"the kernel {why_not()}")
RUNNABLE = {"AVX512": ("AVX512", "AVX2", "default"), "AVX2": ("AVX2", "default")}.get(best_variant(), ("default",))


def compare_random_highways(highways: int, rows: int, decisions: int, seed: int, vehicles: int) -> None:
    """Both decide from every state of the tensor code's episodes."""
    rng, generator = random.Random(seed), torch.Generator().manual_seed(seed)
    compared, at_threshold = 0, 0
    for highway in range(highways):
        env = random_highway(rng, rows, vehicles)
        kernel = kernel_of(env)
        td = disturbed(env, generator) if highway % 2 else env.reset()
        for _ in range(decisions):
            td["action"] = actions(env, generator)
            out = by_kernel(kernel, td, env.recycle)
            stepped, following = env.step_and_maybe_reset(td.clone())
            differs = differing_rows(out, stepped["next"])
            for row in differs.nonzero()[:, 0].tolist():
                assert within_rounding(env, td, row), (seed, highway, row)
            worst = errors(out, stepped["next"], ~differs)
            assert max(worst.values()) < 1e-3, worst
            compared, at_threshold = compared + rows, at_threshold + int(differs.sum())
            td = following
    assert at_threshold <= max(1, compared // 100_000), (at_threshold, compared)


def test_it_decides_as_the_tensor_code_on_random_highways():
    compare_random_highways(highways=40, rows=16, decisions=6, seed=3, vehicles=25)


@pytest.mark.slow
def test_it_decides_as_the_tensor_code_on_a_million_decisions():
    compare_random_highways(highways=800, rows=128, decisions=10, seed=4, vehicles=60)


def test_it_recycles_as_the_tensor_code():
    """Over a minute slow vehicles fall behind and fast ones run away."""
    env = environment(num_envs=32, recycle=True, dtype=torch.float32)
    kernel, td = kernel_of(env), env.reset()
    jumped = 0
    for _ in range(60):
        td["action"] = torch.zeros(32, dtype=torch.int64)
        out = by_kernel(kernel, td, recycle=True)
        after = env.step(td)["next"]
        jumped += int(((out["x"] - td[keys.VEHICLES, "x"]).abs() > 100).sum())
        assert not differing_rows(out, after).any()
        assert max(errors(out, after, torch.ones(32, dtype=torch.bool)).values()) < 1e-3
        td = after.exclude("reward")
    assert jumped > 20


def drive(kernel: Kernel, td, chosen: list[torch.Tensor]) -> list[Outcome]:
    """Decision after decision by the kernel alone; rows that have ended are driven on."""
    td, outcomes = td.clone(), []
    for action in chosen:
        td["action"] = action
        outcomes.append(out := by_kernel(kernel, td))
        for name, value in moved(Vehicles.of(td[keys.VEHICLES]), out).as_dict().items():
            td[keys.VEHICLES, name] = value
        td[keys.TRAFFIC, "steering"], td[keys.STEP] = out["steering"], out["step"]
        for name in ("decisions", "lane_changes", "change_direction", "soft_crash", "soft_crash_behind"):
            td[keys.EGO, name] = out[name]
        td[keys.EGO, "steering"] = out["ego_steering"]
    return outcomes


def test_after_30_s_on_their_own_they_are_within_a_millimetre():
    env = environment(num_envs=64, dtype=torch.float32, seed=5)
    generator = torch.Generator().manual_seed(5)
    td = disturbed(env, generator)
    chosen = [actions(env, generator, change=0.05) for _ in range(30)]
    ours = drive(kernel_of(env), td, chosen)
    same = torch.ones(64, dtype=torch.bool)
    for action, out in zip(chosen, ours):
        td["action"] = action
        after = env.step(td)["next"]
        same &= ~differing_rows(out, after)
        worst = errors(out, after, same)
        assert max(worst["x"], worst["y"]) < 1e-3
        same &= ~after["done"][:, 0]
        td = after.exclude("reward")
    assert int(same.sum()) > 20


@pytest.mark.parametrize("seed", range(4))
def test_it_agrees_with_the_scalar_twin(seed):
    rng, generator = random.Random(seed), torch.Generator().manual_seed(seed)
    for highway in range(6):
        env = random_highway(rng, 4, most_vehicles=15)
        env.recycle = False
        td = disturbed(env, generator) if highway % 2 else env.reset()
        td["action"] = actions(env, generator, change=0.5)
        out = by_kernel(kernel_of(env), td)
        for row in range(4):
            state = scalar_state(td, row)
            outcome = scalar.decide(state, int(td["action"][row]), rules_of(env))
            for name in MOTION:
                expected = torch.tensor([getattr(car, name) for car in state.cars])
                assert out[name][row] == pytest.approx(expected, abs=1e-3), (name, row)
            assert out["target_lane"][row].tolist() == [car.target_lane for car in state.cars]
            reasons = [name for name in keys.END_EVENTS[:4] if out[name][row]]
            assert (reasons, int(out["soft_crashes"][row])) == (outcome.reasons, outcome.soft_crash)
            assert (int(out["soft_crashes_behind"][row]), int(out["step"][row])) == (
                outcome.soft_crash_behind,
                state.step,
            )
            assert out["mean_acceleration"][row].item() == pytest.approx(outcome.mean_acceleration, abs=1e-3)
            assert out["change_progress"][row].item() == pytest.approx(outcome.progress, abs=1e-4)


@pytest.fixture(scope="module", params=[True, False], ids=["idm_mobil", "idm"])
def crowd(request):
    """4096 rows in motion, and what one call makes of them."""
    env = environment(num_envs=4096, mobil=request.param, dtype=torch.float32, seed=9)
    td = disturbed(env, torch.Generator().manual_seed(9))
    td["action"] = actions(env, torch.Generator().manual_seed(10))
    return env, td, by_kernel(kernel_of(env), td, recycle=True)


def assert_same_bits(some: Outcome, other: Outcome) -> None:
    for name, one in some.items():
        assert torch.equal(one, other[name]), name


@pytest.mark.parametrize("batch", [1, 7, 64])
def test_a_row_is_the_same_bit_for_bit_in_any_batch(crowd, batch):
    env, td, whole = crowd
    kernel = kernel_of(env)
    for start in range(0, 60 * batch if batch < 64 else 4096, batch):
        rows = slice(start, start + batch)
        assert_same_bits(
            by_kernel(kernel, td[rows], recycle=True), {name: field[rows] for name, field in whole.items()}
        )


@pytest.mark.parametrize("variant", RUNNABLE)
def test_every_instruction_set_gives_the_same_bits(crowd, variant):
    env, td, whole = crowd
    assert variant in VARIANTS
    assert_same_bits(by_kernel(kernel_of(env, variant), td, recycle=True), whole)


def test_two_threads_give_the_same_bits(crowd):
    env, td, whole = crowd
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        assert_same_bits(by_kernel(kernel_of(env), td, recycle=True), whole)
    finally:
        torch.set_num_threads(before)


def test_what_goes_in_stays_as_it_is_and_need_not_be_contiguous(crowd):
    env, td, whole = crowd
    before = td.clone()
    strided = td.apply(lambda value: value.repeat_interleave(2, dim=0)[::2], batch_size=[4096])
    assert_same_bits(by_kernel(kernel_of(env), strided, recycle=True), whole)
    assert (td == before).all()


def test_a_row_that_leaves_the_road_does_not_move():
    env = environment(lanes=1, num_envs=3, dtype=torch.float32)
    td = env.reset()
    td["action"] = torch.tensor([keys.KEEP, keys.LEFT, keys.RIGHT])
    out = by_kernel(kernel_of(env), td)
    assert out["out_of_road"][:, 0].tolist() == out["terminated"][:, 0].tolist() == [False, True, True]
    assert torch.equal(out["x"][1:], td[keys.VEHICLES, "x"][1:])
    assert out["step"].tolist() == [10, 0, 0]


def test_a_ring_is_refused_in_one_sentence():
    with pytest.raises(UserError, match="must be straight"):
        Kernel(Road(3, ring_m=500.0), 9)
