"""Traffics for tests, films of their physics steps, and what is seen on them."""

from __future__ import annotations

import torch
from reference.worlds import film_of
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


def start(env, episodes):
    """The start of certain episodes."""
    episode = torch.as_tensor(episodes)
    numbers = {keys.SEED: torch.zeros_like(episode), keys.EPISODE: episode}
    return env.reset(TensorDict(numbers, episode.shape))


def keep_lane(td):
    """Nobody is commanded to change."""
    return torch.zeros(td.batch_size, dtype=torch.int64)


def drive(env, episodes, decisions, act=keep_lane):
    """The vehicles [T + 1, N, M] after each physics step, which rows ran in it [T, N], and the last
    state.
    """
    state = start(env, episodes)
    frames = [Vehicles.of(state[keys.VEHICLES])]
    running = []
    done = state["done"][:, 0]

    def record(vehicles, rows):
        frames.append(vehicles)
        running.append(rows & ~done)

    env.recorder = record
    for _ in range(decisions):
        done = state["done"][:, 0]
        state = env.step(state.set(keys.ACTION, act(state)))["next"].clone()
        state["done"] |= done[:, None]
        if state["done"].all():
            break
    env.recorder = None
    return film_of(frames), torch.stack(running), state


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


#: Makers of the traffics that run on all their rows alike; faults are so frequent that a few
#: decisions hold some.
MAKE = {
    "idm": IdmTraffic,
    "idm_mobil": IdmMobilTraffic,
    "idm_random": IdmRandomTraffic,
    "idm_faults": lambda: idm_faults_traffic(faults=all_faults(600.0, 0.5)),
    "gan": gan_traffic,
}
