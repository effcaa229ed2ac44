"""Drives random configurations for a long time and checks after every decision what must hold in
all of them.
"""

from __future__ import annotations

import itertools
import os
import random
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

import ganlane
from ganlane import build, keys
from ganlane.env import HighwayEnv
from ganlane.errors import UserError
from ganlane.settings.observation import FORMS
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.state import Vehicles

from .tally import Tally

#: Recordings, where there are any.
DATA = Path(os.environ.get("GANLANE_DATA", "../shared/data")).absolute()
RECORDINGS = DATA / "ngsim" / "us101_scenes.csv"
RULES = ("idm", "idm_mobil")
TRAFFICS = (*RULES, *RULES, "idm_random", "idm_faults", "human", "gan", "gan_calibrated", "mixed")
ENVS = ("highway", "highway", "highway", "dense", "cut_in", "stalled_car", "stop_and_go")
ROADS = ("merge", "on_ramp", "lane_drop", "weave", "exit")
ENVS += (*ROADS, "blocked_lane", "replay")
#: For which each configuration is driven.
SECONDS = 2.0
#: Pairs of vehicles in all rows together; generated traffic needs a kilobyte or more for each.
MOST_PAIRS = 2_000_000
#: Vehicles of a scenario, at most.
IN_SCENARIO = 44
#: Nobody drives faster, m/s; rule-driven traffic not faster than it wants to, or did.
FASTEST_MPS = 70.0


def soak(tally: Tally, seed: int, end: float, scratch: Path) -> None:
    """Drive configurations, each for a moment, until the monotonic clock is at ``end``; writes
    nothing.
    """
    torch.set_num_threads(1)
    for number in itertools.count(seed * 10**6):
        if time.monotonic() > end:
            return
        one_configuration(tally, number, time.monotonic() + SECONDS)


def once(number: int) -> str:
    """The configuration of this number again, for a minute."""
    tally = Tally("soak")
    one_configuration(tally, number, time.monotonic() + 60.0)
    return tally.row()


def one_configuration(tally: Tally, number: int, until: float) -> None:
    """The first choice of this number that is not refused, driven until then."""
    rng = random.Random(number)
    while True:
        choice = random_choice(rng)
        try:
            env = make(choice)
            break
        except UserError:  # its parts do not fit together
            continue
    what = f"configuration {number} (soak --configuration {number}): {choice}"
    drive(tally, env, choice, what, until)
    tally.what["configurations"] += 1


def random_choice(rng: random.Random) -> dict[str, Any]:
    """Random arguments of :func:`ganlane.make_env`, and ``policy`` and ``float64`` of ours."""
    env = rng.choice(ENVS if RECORDINGS.is_file() else ENVS[:-1])
    traffic: dict[str, Any] = {"name": rng.choice(TRAFFICS)}
    if rng.random() < 0.15:
        traffic["blind_share"] = 0.5
    choice: dict[str, Any] = {
        "env": env,
        "observation": rng.choice(FORMS),
        "mask": rng.choice(("none", "legal", "safe", "foresight")),
        "seed": rng.randrange(2**40),
        "decision_period_s": rng.choice((0.1, 0.3, 0.5, 1.0, 1.0, 1.0, 2.0)),
        "goal_m": rng.choice((30.0, 200.0, 1000.0, 5000.0)),
        "timeout_s": rng.choice((3.0, 60.0, 1000.0)),
        "recycle": env not in ("replay", *ROADS) and rng.random() < 0.4,
        "recycle_share": rng.choice((1.0, 0.5)),
        "kernel": rng.choice(("auto", "torch")),
        "ego": {
            "abort_lane_change": rng.random() < 0.5,
            "visibility": rng.choice(("centre", "body", "signalled")),
        },
        "float64": rng.random() < 0.3,
        "policy": rng.choice(("random", "random", "legal", "keep", "weave")),
    }
    if env in ("highway", "dense", "replay"):
        choice["lanes"] = rng.randint(1, 6)
        choice["vehicles"] = rng.randint(2, min(40, 6 * choice["lanes"] + 2))
        choice["spread_m"] = rng.choice((200.0, 400.0, 1500.0))
        choice["truck_share"] = rng.choice((0.0, 0.0, 0.3))
    most = MOST_PAIRS // choice.get("vehicles", IN_SCENARIO) ** 2
    choice["num_envs"] = min(most, rng.choice((1, 3, 64, 256, 1024, 1024, 4096)))
    if env == "replay":
        traffic = {"name": "replay", "path": str(RECORDINGS)}
        choice["env"] = "highway"
        del choice["vehicles"]
    return {**choice, "traffic": traffic}


def make(choice: dict[str, Any]) -> TransformedEnv:
    """The environment of a choice."""
    options = {name: value for name, value in choice.items() if name not in ("float64", "policy")}
    dtype = torch.float64 if choice["float64"] else torch.float32
    with patch.object(build, "HighwayEnv", partial(HighwayEnv, dtype=dtype)):
        return ganlane.make_env(**options)


def drive(
    tally: Tally, env: TransformedEnv, choice: dict[str, Any], what: str, until: float
) -> None:
    """Drive until the time is over, or something breaks."""
    generator = torch.Generator().manual_seed(choice["seed"])
    rows, substeps = env.batch_size[0], env.base_env.episode.substeps()
    decisions = 0
    try:
        td = env.reset()
        while decisions < 3 or time.monotonic() < until:
            before = td.set("action", actions(choice["policy"], td, generator))
            stepped, td = env.step_and_maybe_reset(td)
            decisions += 1
            broken = list(violations(env.base_env, choice, before, stepped["next"], td))
            if broken:
                tally.fail(f"{what}: decision {decisions}: {'; '.join(broken)}")
                break
    except Exception as error:
        tally.fail(f"{what}: decision {decisions}: {type(error).__name__}: {error}"[:1500])
    tally.what["decisions"] += rows * decisions
    tally.what["physics steps"] += rows * decisions * substeps


def actions(policy: str, td: TensorDictBase, generator: torch.Generator) -> torch.Tensor:
    """Actions [N]: any, legal ones where there is a mask, keeping the lane, or seldom a change."""
    rows = td.batch_size
    drawn = torch.randint(3, rows, generator=generator)
    mask = td.get(keys.ACTION_MASK, None)
    if policy == "keep":
        return torch.zeros(rows, dtype=torch.int64)
    if policy == "weave":
        return torch.where(torch.rand(rows, generator=generator) < 0.2, drawn, 0)
    if policy == "legal" and mask is not None:
        return torch.multinomial(mask.float(), 1, generator=generator)[..., 0]
    return drawn


def violations(
    base: HighwayEnv,
    choice: dict[str, Any],
    before: TensorDictBase,
    after: TensorDictBase,
    following: TensorDictBase,
) -> Iterator[str]:
    """What does not hold after a decision that led from ``before`` to ``after``, and with resets to
    ``following``.
    """
    was, now = Vehicles.of(before.get(keys.VEHICLES)), Vehicles.of(after.get(keys.VEHICLES))
    done = after["done"][:, 0]
    steps, full = after[keys.STEP] - before[keys.STEP], base.episode.substeps()
    ends = torch.cat([after[keys.EVENTS, name] for name in keys.END_EVENTS], 1)
    next_episode = before[keys.EPISODE] + torch.where(done, base.batch_size[0], 0)
    going = ~done
    mask = following.get(keys.ACTION_MASK, None)
    holds = {
        "not exactly one reason for an end": ends.sum(1) == done,
        "terminated without its event": _any(after, keys.TERMINAL_EVENTS) == after["terminated"],
        "truncated without its event": _any(after, keys.TRUNCATING_EVENTS) == after["truncated"],
        # Driving off the road ends an episode before its first physics step.
        "a decision of another length": ((steps == full) | done) & (steps >= 0) & (steps <= full),
        "another seed within an episode": before[keys.SEED] == after[keys.SEED],
        "another episode within an episode": before[keys.EPISODE] == after[keys.EPISODE],
        "a negative number of soft crashes": after[keys.EVENTS, keys.SOFT_CRASH] >= 0,
        "not the next episode after an end": following[keys.EPISODE] == next_episode,
        "not from its start after an end": following[keys.STEP][done] == 0,
        "a reset of others moved somebody": following[keys.VEHICLES, "x"][going] == now.x[going],
        "no action allowed": torch.ones(1) if mask is None else mask.any(1),
    }
    for name in ("distance", "lane_changes"):
        holds[f"{name} fell"] = after[keys.EGO, name] >= before[keys.EGO, name]
    holds |= of_the_state(base, choice, was, now, after)
    for name, condition in holds.items():
        if not condition.all():
            yield name


def _any(after: TensorDictBase, names: tuple[str, ...]) -> torch.Tensor:
    return torch.cat([after[keys.EVENTS, name] for name in names], 1).any(1, keepdim=True)


def of_the_state(
    base: HighwayEnv, choice: dict[str, Any], was: Vehicles, now: Vehicles, after: TensorDictBase
) -> dict[str, torch.Tensor]:
    """What must hold of the vehicles, the observation and the reward, by what is wrong if not."""
    rule_driven = choice["traffic"]["name"] in RULES
    # Who is just below its desired speed may accelerate for one more step.
    overshoot = base.rules.idm.max_acceleration * keys.PHYSICS_STEP_S + 1e-3
    wanted = torch.maximum(was.speed, now.desired_speed) + overshoot
    bound = wanted if rule_driven else torch.full_like(wanted, FASTEST_MPS)
    bound[:, 0] = wanted[:, 0]
    lanes = after[keys.ROAD, "lanes"] if base.traffic.own_roads else base.road.lanes
    numbers = [after[keys.VEHICLES, name] for name in keys.VEHICLE_FLOATS]
    numbers += [after[keys.OBSERVATION], after[keys.REWARD], after[keys.EGO, "distance"]]
    holds = {
        "not finite": torch.stack([torch.isfinite(value).all() for value in numbers]),
        "a negative speed": now.speed >= 0.0,
        "faster than allowed": (now.speed <= bound) | ~now.valid,
        "a lane that is not there": (now.target_lane >= 0) & (now.target_lane < lanes) | ~now.valid,
    }
    # With an ego that keeps its lane, rule-driven cars never touch each other.
    alone = choice["policy"] == "keep" and "blind_share" not in choice["traffic"]
    if rule_driven and alone and choice["env"] in ("highway", "dense", *ROADS):
        touching = pair_overlaps(now).any(-1).any(-1)
        holds["rule-driven cars overlap"] = ~touching | after[keys.EVENTS, "hard_crash"][:, 0]
    return holds
