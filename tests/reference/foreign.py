"""Runs for tests of traffic: certain episodes, commands, and every physics step of them."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.settings.driving import (
    AbortFaults,
    BrakingFaults,
    DriverFaults,
    HesitationFaults,
    ReactionFaults,
)
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.state import Vehicles, lateral_half_extent
from ganlane.traffic import IdmMobilTraffic, IdmRandomTraffic, IdmTraffic
from ganlane.traffic.presets import gan_traffic, idm_faults_traffic


def start(env, episodes, seed=0):
    """The start of certain episodes."""
    episode = torch.as_tensor(episodes)
    numbers = {keys.SEED: torch.full_like(episode, seed), keys.EPISODE: episode}
    return env.reset(TensorDict(numbers, episode.shape))


def drive(env, episodes, decisions, command=lambda decision, episode: 0):
    """The vehicles [T + 1, N, M] after each physics step, which rows ran in it [T, N], and the last
    state.
    """
    state = start(env, episodes)
    steps = [Vehicles.of(state[keys.VEHICLES])]
    running = []
    done = state["done"][:, 0]

    def record(vehicles, rows):
        steps.append(vehicles)
        running.append(rows & ~done)

    env.recorder = record
    for decision in range(decisions):
        state[keys.ACTION] = torch.tensor([command(decision, episode) for episode in episodes])
        done = state["done"][:, 0]
        state = env.step(state)["next"].clone()
        state["done"] |= done[:, None]
        if state["done"].all():
            break
    env.recorder = None
    return Vehicles(*(torch.stack(fields) for fields in zip(*steps))), torch.stack(running), state


def others_of(traffic, rows, decisions, vehicles=9, kernel="torch"):
    """The others [T + 1, N, M - 1] after every physics step beside a keep-lane ego, and the last
    state.
    """
    env = HighwayEnv(traffic, rows, vehicles, kernel=kernel)
    film, _, state = drive(env, range(rows), decisions)
    return Vehicles(*(field[..., 1:] for field in film)), state


def beyond_the_edge(vehicles):
    """How far the outermost body reaches past the edge of a road of three lanes, m; negative
    inside.
    """
    # Of the middle of the middle lane, from which the edges are 6 m away.
    off = (vehicles.y - 4.0).abs() + lateral_half_extent(vehicles)
    return off.max().item() - 6.0


def assert_close(some, others):
    """That vehicles drive where others do, up to the rounding of a network in another batch."""
    for name in ("x", "y", "speed"):
        torch.testing.assert_close(some[name], others[name], atol=2e-3, rtol=1e-4)


def all_faults(per_hour, share):
    """All four: so many attacks an hour, so large a share of the lane changes."""
    return DriverFaults(
        BrakingFaults(per_hour),
        ReactionFaults(per_hour),
        HesitationFaults(share),
        AbortFaults(share),
    )


def overlaps(vehicles):
    """Pairs whose bodies overlap, counted twice, in all steps [T, N, M]."""
    return pair_overlaps(Vehicles(*(field.flatten(0, 1) for field in vehicles))).sum().item()


def overlaps_of_the_others(env, least_km, seconds=None, ego=False):
    """Steps with overlaps in ``least_km`` of the others' driving, in episodes of ``seconds``.

    ``ego``: its, too.
    """
    km = 0.0
    count = 0
    first = 0 if ego else 1
    decisions = 0

    def record(now, running):
        nonlocal km, count
        km += (now.speed * running[:, None])[:, 1:].sum().item() * 1e-4
        count += pair_overlaps(now)[:, first:, first:].sum().item()

    env.recorder = record
    state = env.reset()
    keep = torch.zeros(env.batch_size, dtype=torch.int64)
    while km < least_km:
        decisions += 1
        state = env.step(state.set(keys.ACTION, keep))["next"]
        if seconds and decisions % seconds == 0:
            state = start(env, state[keys.EPISODE] + env.batch_size[0])
    return count


def assert_same_alone(make, traffic, episodes, decisions):
    """Every episode of a batch is bit for bit the same as by itself in the environment
    ``make(traffic, 1)``.
    """
    together, running, _ = drive(make(traffic, len(episodes)), episodes, decisions, turns)
    for row, episode in enumerate(episodes):
        alone, ran, _ = drive(make(traffic, 1), [episode], decisions, turns)
        count = int(running[:, row].sum())
        assert count == int(ran[:, 0].sum()) > 0
        for one, all_ in zip(alone, together):
            assert torch.equal(one[: count + 1, 0], all_[: count + 1, row])


def turns(decision, episode):
    """Now and then a change of lanes, in no order."""
    return (decision * 7 + episode) % 3 if decision % 4 == 0 else 0


#: Makers of the traffics that run on all their rows alike; faults are so frequent that a few
#: decisions hold some.
MAKE = {
    "idm": IdmTraffic,
    "idm_mobil": IdmMobilTraffic,
    "idm_random": IdmRandomTraffic,
    "idm_faults": lambda: idm_faults_traffic(faults=all_faults(600.0, 0.5)),
    "gan": gan_traffic,
}
