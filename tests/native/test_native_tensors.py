"""The native kernel on tensors, on random highways in float32.

Against the tensor code, and against itself.
"""

import random

import pytest
import torch
from reference.kernels import apart, kernel_of
from reference.refusals import user_error
from reference.worlds import (
    KINDS,
    disturbed_start,
    drawing,
    environment,
    leaves,
    random_actions,
    random_environment,
    same_bits,
)
from tensordict import TensorDict

from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.native.drivers import RuleDrivers
from ganlane.native.tensors import Kernel, NativeScenes
from ganlane.settings.driving import EgoParameters, Visibility
from ganlane.settings.episode import EpisodeParameters, SpawnParameters
from ganlane.sim.random import episode_key
from ganlane.sim.spawn import RandomScenes
from ganlane.sim.state import Road, Vehicles

pytestmark = pytest.mark.kernel


def odd_start(env, generator):
    """A disturbed first state, in which some are far away, across the road or long."""
    td = disturbed_start(env, generator)
    between = drawing(td[keys.VEHICLES, "x"].shape, generator, env.dtype)
    td[keys.VEHICLES, "x"] *= 1 + 3 * (between(0, 1) < 0.05)
    td[keys.VEHICLES, "heading"] *= 1 + 20 * (between(0, 1) < 0.02)
    td[keys.VEHICLES, "length"] += 8 * (between(0, 1) < 0.1)
    return td


def by_kernel(kernel, td, recycle=False):
    """The decision ``td["action"]`` from the state ``td``."""
    recycles = torch.ones(len(td), dtype=torch.bool) if recycle else None
    return kernel.decide(td["action"], td, recycles)


def in_double(value):
    """A copy, in double precision if it is a number."""
    return value.double() if value.is_floating_point() else value.clone()


def within_rounding(env, td, row, measure):
    """Whether the decision of ``row`` hangs by a rounding.

    64 states a rounding beside it lead to different ones, by the same ``measure`` of :func:`apart`.
    """
    copies = 64
    exact = HighwayEnv(
        env.traffic, copies, env.vehicles, env.spawn_parameters, env.ego, env.episode,
        dtype=torch.float64, recycle=env.recycle, actions=env.actions,
    )  # fmt: skip
    state = td[row : row + 1].expand(copies).apply(in_double)
    between = drawing((copies, env.vehicles), 0)
    for name, size in (("x", 2e-5), ("y", 2e-6), ("speed", 4e-6), ("heading", 2e-7)):
        state[keys.VEHICLES, name] += size * between(-1.0, 1.0)
    after = exact.step(state)["next"]
    return bool(apart(after, after[:1].expand(copies))[measure].any())


# As the tensor code


def compare_random_highways(kinds, highways, rows, decisions, vehicles):
    """Both decide from every state of the tensor code's episodes, on highways of all kinds in
    turn; what there was of events, and of drivers who changed, entered, left or came back.
    """
    rng = random.Random(5)
    generator = torch.Generator().manual_seed(3)
    at_threshold = 0
    seen = set()
    for highway in range(highways):
        road, form = kinds[highway % len(kinds)]
        env = random_environment(rng, rows, road, form, vehicles)
        kernel = kernel_of(env)
        td = odd_start(env, generator) if highway % 2 else env.reset()
        for _ in range(decisions):
            td["action"] = random_actions(env, generator)
            out = by_kernel(kernel, td, env.recycle or road == "flow")
            stepped, following = env.step_and_maybe_reset(td.clone())
            after = stepped["next"]
            # With pedals and wheel the traffic's memory of the ego is nobody's concern.
            events, numbers = apart(out, after, of_ego=form != "continuous")
            for measure, differs in enumerate((events, numbers & ~events)):
                for row in differs.nonzero()[:, 0].tolist():
                    assert within_rounding(env, td, row, measure), (highway, row)
                    at_threshold += 1
            seen |= happened(road, td, after)
            td = following
    assert at_threshold <= max(1, highways * rows * decisions // 100_000), at_threshold
    return seen


def happened(road, before, after):
    """Events of a decision, and what drivers other than the ego did."""
    was, now = (
        Vehicles.of(state[keys.VEHICLES]).columns(slice(1, None)) for state in (before, after)
    )
    drove = was.valid & now.valid
    happens = {
        **after[keys.EVENTS],
        "started_change": after[keys.EGO, "started_change"],
        "changed": drove & (now.target_lane != was.target_lane),
        "entered": now.valid & ~was.valid,
        "left": was.valid & ~now.valid,
        "came back": drove & ((now.x - was.x).abs() > 100.0),
    }
    return {name for name, where in happens.items() if where.any()}


def test_it_decides_as_the_tensor_code_on_random_highways():
    seen = compare_random_highways(KINDS, highways=18, rows=64, decisions=5, vehicles=25)
    # Recordings alone end with their scene.
    events = {*keys.END_EVENTS, *keys.EVENT_COUNTS, "started_change"} - {"scene_end"}
    assert seen >= events | {"changed", "entered", "left", "came back"}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids="-".join)
def test_it_decides_as_the_tensor_code_a_million_times_in_all(kind):
    compare_random_highways([kind], highways=90, rows=128, decisions=10, vehicles=60)


def test_a_ring_is_refused_in_one_sentence():
    with user_error("must be straight"):
        Kernel(Road(3, ring_m=500.0), 9, EpisodeParameters(), EgoParameters(), RuleDrivers())


def test_what_goes_in_stays_as_it_is_and_need_not_be_contiguous():
    env = environment(num_envs=64, dtype=torch.float32, seed=9)
    td = disturbed_start(env, torch.Generator().manual_seed(9))
    td["action"] = random_actions(env, torch.Generator().manual_seed(10))
    before = td.clone()
    strided = td.apply(lambda value: value.repeat_interleave(2, dim=0)[::2], batch_size=[64])
    one, other = (by_kernel(kernel_of(env), state, recycle=True) for state in (td, strided))
    assert same_bits(one, other) == []
    assert (td == before).all()


# First scenes


@pytest.mark.parametrize(
    "scenes",
    [
        RandomScenes(parameters=SpawnParameters(truck_share=0.4)),
        RandomScenes(Road(lanes=1, lane_width_m=3.2), 5),
        RandomScenes(
            Road(lanes=5),
            40,
            SpawnParameters(spread_m=400.0),
            Visibility.SIGNALLED,
            Visibility.BODY,
        ),
    ],
    ids=["lorries", "one lane", "a crowd"],
)
def test_every_number_of_a_first_scene_is_that_of_the_tensor_code(scenes):
    seed = torch.full((200,), 7)
    episode = torch.arange(200) * 13 - 50
    state = NativeScenes(scenes, 2, RuleDrivers()).start(seed, episode)
    expected = scenes(episode_key(2, seed, episode), torch.float32)
    assert same_bits(state[keys.VEHICLES], TensorDict(expected.as_dict(), [200])) == []
    rest = state.exclude(keys.VEHICLES, keys.SEED, keys.EPISODE)
    assert not any(bool(value.any()) for _, value in leaves(rest))


def test_rows_that_are_not_asked_for_stay_empty():
    seed = torch.zeros(600, dtype=torch.int64)
    episode = torch.arange(600)
    rows = torch.arange(600) % 7 == 3
    kernel = NativeScenes(RandomScenes(), 2, RuleDrivers())
    some, every = (kernel.start(seed, episode, drawn)[keys.VEHICLES] for drawn in (rows, None))
    assert torch.equal(some["x"][rows], every["x"][rows])
    assert not some["valid"][~rows].any()
    assert not some["x"][~rows].any()
