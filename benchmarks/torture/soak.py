"""Drives random configurations for a long time and checks after every decision what must hold in
all of them.
"""

from __future__ import annotations

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
from benchmarks.torture.tally import Tally
from ganlane import build, keys
from ganlane.env import HighwayEnv
from ganlane.errors import UserError
from ganlane.settings.observation import FORMS
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.state import Vehicles

#: Recordings, where there are any.
RECORDINGS = (
    Path(os.environ.get("GANLANE_DATA", "../shared/data")).absolute() / "ngsim" / "us101_scenes.csv"
)
RULES = ("idm", "idm_mobil")
TRAFFICS = (*RULES, *RULES, "idm_random", "idm_faults", "gan", "gan_calibrated", "mixed")
SCENARIOS = ("cut_in", "stalled_car", "stop_and_go", "blocked_lane")
#: Pairs of vehicles in all rows together; generated traffic needs a kilobyte or more for each.
MOST_PAIRS = 2_000_000
#: Vehicles of a scenario, at most.
IN_SCENARIO = 44
#: Nobody drives faster, m/s; rule-driven traffic not faster than it wants to, or did.
FASTEST_MPS = 70.0
#: Resident memory may vary by this share over the last half of a long run.
FLAT = 0.02


def soak(tally: Tally, count: int, seed: int, minutes: float, compiled: int = 0) -> None:
    """Drive ``count`` configurations, each for its share of the minutes; the first ``compiled`` are
    compiled.

    Where making them takes longer than that, fewer are driven.
    """
    torch.set_num_threads(1)
    begun = time.monotonic()
    for number in range(count):
        if time.monotonic() > begun + 60.0 * minutes:
            return
        until = begun + 60.0 * minutes * (number + 1) / count
        _configuration(tally, seed * 10**6 + number, compiled > number, until)


def once(number: int) -> int:
    """The configuration of this number again, for a minute; the exit status."""
    tally = Tally("soak")
    _configuration(tally, number, False, time.monotonic() + 60.0)
    return int(tally.failed > 0)


def _configuration(tally: Tally, number: int, compiled: bool, until: float) -> None:
    """The first choice of this number that is not refused, driven until then, or at least for a
    moment.
    """
    for choice in _choices(random.Random(number), compiled):
        try:
            env = made(choice)
        except UserError:
            tally.detail["refused in a sentence"] += 1
            continue
        _driven(tally, env, choice, number, max(until, time.monotonic() + 0.2))
        tally.what["configurations"] += 1
        return


def _choices(rng: random.Random, compiled: bool) -> Iterator[dict[str, Any]]:
    """Random arguments of :func:`ganlane.make_env`, and some of ours.

    Some of them do not fit together.
    """
    while True:
        kind = rng.choices(("highway", "dense", "scenario", "replay"), (5, 2, 3, 1))[0]
        traffic: dict[str, Any] = {"name": rng.choice(TRAFFICS)}
        chosen: dict[str, Any] = {
            "env": rng.choice(SCENARIOS)
            if kind == "scenario"
            else "dense"
            if kind == "dense"
            else "highway",
            "num_envs": rng.choice((1, 3, 64, 256, 1024, 1024, 4096)),
            "observation": rng.choice(FORMS),
            "mask": rng.choice(("none", "legal", "safe")),
            "seed": rng.randrange(2**40),
            "decision_period_s": rng.choice((0.1, 0.3, 0.5, 1.0, 1.0, 1.0, 2.0)),
            "goal_m": rng.choice((30.0, 200.0, 1000.0, 5000.0)),
            "timeout_s": rng.choice((3.0, 60.0, 1000.0)),
            "recycle": rng.random() < 0.4,
            "recycle_share": rng.choice((1.0, 0.5)),
            "kernel": "auto" if rng.random() < 0.5 else "torch",
            "ego": {
                "abort_lane_change": rng.random() < 0.5,
                "visibility": rng.choice(("centre", "body", "signalled")),
            },
            "float64": rng.random() < 0.3,
            "policy": rng.choice(("random", "random", "legal", "keep", "weave")),
            "compile": compiled,
        }
        if rng.random() < 0.15:
            traffic["blind_share"] = 0.5
        if kind in ("highway", "dense", "replay"):
            lanes = rng.randint(1, 6)
            chosen |= {"lanes": lanes, "vehicles": rng.randint(2, min(40, 6 * lanes + 2))}
            chosen |= {
                "spread_m": rng.choice((200.0, 400.0, 1500.0)),
                "truck_share": rng.choice((0.0, 0.0, 0.3)),
            }
        pairs = chosen.get("vehicles", IN_SCENARIO) ** 2
        chosen["num_envs"] = min(chosen["num_envs"], MOST_PAIRS // pairs)
        if kind == "replay":
            if not RECORDINGS.is_file():
                continue
            traffic = {"name": "replay", "path": str(RECORDINGS)}
            chosen = {name: value for name, value in chosen.items() if name != "vehicles"} | {
                "recycle": False
            }
        yield {**chosen, "traffic": traffic}


def made(choice: dict[str, Any]) -> TransformedEnv:
    """The environment of a choice."""
    options = {name: value for name, value in choice.items() if name not in ("float64", "policy")}
    dtype = torch.float64 if choice["float64"] else torch.float32
    with patch.object(build, "HighwayEnv", partial(HighwayEnv, dtype=dtype)):
        return ganlane.make_env(**options)


def _driven(
    tally: Tally, env: TransformedEnv, choice: dict[str, Any], number: int, until: float
) -> None:
    """Drive until the time is over; what breaks is counted once per configuration."""
    base, rows = env.base_env, env.batch_size[0]
    generator = torch.Generator().manual_seed(number)
    begun, decisions = time.monotonic(), 0
    what = f"configuration {number} (soak --configuration {number}): {choice}"
    try:
        td = env.reset()
        while decisions < 3 or time.monotonic() < until:
            td["action"] = actions(choice["policy"], td, generator)
            before = td
            stepped, td = env.step_and_maybe_reset(td)
            decisions += 1
            broken = list(violations(base, choice, before, stepped["next"], td))
            if broken:
                tally.fail(f"{what}: decision {decisions}: {'; '.join(broken)}")
                break
    except Exception as error:
        tally.fail(f"{what}: decision {decisions}: {type(error).__name__}: {error}"[:1500])
    tally.what["decisions"] += rows * decisions
    tally.what["physics steps"] += rows * decisions * base.episode.substeps()
    kind = "float64" if choice["float64"] else "float32"
    driver = (
        "compiled"
        if choice["compile"]
        else "the native kernel"
        if base.kernel is not None
        else "tensor code"
    )
    for name in (kind, driver, choice["traffic"]["name"], choice["env"]):
        tally.detail[f"decisions: {name}"] += rows * decisions
        tally.detail[f"configurations: {name}"] += 1
    tally.detail["seconds driven"] += round(time.monotonic() - begun)


def actions(policy: str, td: TensorDictBase, generator: torch.Generator) -> torch.Tensor:
    """Actions [N].

    Any, legal ones where there is a mask, none but keeping the lane, or seldom a change.
    """
    rows = td.batch_size
    if policy == "keep":
        return torch.zeros(rows, dtype=torch.int64)
    chosen = torch.randint(3, rows, generator=generator)
    if policy == "weave":
        return torch.where(torch.rand(rows, generator=generator) < 0.2, chosen, 0)
    mask = td.get(keys.ACTION_MASK, None)
    if policy == "legal" and mask is not None:
        return torch.multinomial(mask.float(), 1, generator=generator)[..., 0]
    return chosen


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
    yield from _in_the_state(base, choice, before, was, now, after)
    done, steps = after["done"][:, 0], after[keys.STEP] - before[keys.STEP]
    ends = torch.cat([after[keys.EVENTS, name] for name in keys.END_EVENTS], 1)
    ended = {name: ends[:, i] for i, name in enumerate(keys.END_EVENTS)}
    if not (ends.sum(1) == done).all():
        yield "not exactly one reason for an end"
    if not (
        sum(ended[name] for name in keys.TERMINAL_EVENTS).bool() == after["terminated"][:, 0]
    ).all():
        yield "terminated without its event, or the reverse"
    if not (
        sum(ended[name] for name in keys.TRUNCATING_EVENTS).bool() == after["truncated"][:, 0]
    ).all():
        yield "truncated without its event, or the reverse"
    full = base.episode.substeps()
    # Driving off the road ends an episode before its first physics step.
    if not (((steps == full) | done) & (steps >= 0) & (steps <= full)).all():
        yield "a decision of another length"
    for name in (keys.SEED, keys.EPISODE):
        if not torch.equal(before[name], after[name]):
            yield f"another {name} within an episode"
    for name in ("distance", "lane_changes"):
        if not (after[keys.EGO, name] >= before[keys.EGO, name]).all():
            yield f"{name} fell"
    if not (after[keys.EVENTS, keys.SOFT_CRASH] >= 0).all():
        yield "a negative number of soft crashes"
    expected = before[keys.EPISODE] + torch.where(done, base.batch_size[0], 0)
    if not (
        torch.equal(following[keys.EPISODE], expected) and (following[keys.STEP][done] == 0).all()
    ):
        yield "not the next episode, from its start, after an end"
    going = ~done
    if not torch.equal(following[keys.VEHICLES, "x"][going], now.x[going]):
        yield "a reset of others moved somebody"
    mask = following.get(keys.ACTION_MASK, None)
    if mask is not None and not mask.any(1).all():
        yield "no action allowed"


def _in_the_state(
    base: HighwayEnv,
    choice: dict[str, Any],
    before: TensorDictBase,
    was: Vehicles,
    now: Vehicles,
    after: TensorDictBase,
) -> Iterator[str]:
    """What does not hold of the vehicles, the observation and the reward."""
    numbers = [after[keys.VEHICLES, name] for name in keys.VEHICLE_FLOATS]
    for value in (
        *numbers,
        after[keys.OBSERVATION],
        after[keys.REWARD],
        after[keys.EGO, "distance"],
    ):
        if not torch.isfinite(value).all():
            yield "not finite"
            break
    if not (now.speed >= 0.0).all():
        yield f"a negative speed, {now.speed.min():g} m/s"
    traffic = choice["traffic"]["name"]
    # Who is just below its desired speed may accelerate for one more step.
    overshoot = base.rules.idm.max_acceleration * keys.PHYSICS_STEP_S + 1e-3
    wanted = torch.maximum(was.speed, now.desired_speed) + overshoot
    bound = wanted if traffic in RULES else torch.full_like(wanted, FASTEST_MPS)
    bound[:, 0] = wanted[:, 0]
    if not ((now.speed <= bound) | ~now.valid).all():
        yield f"faster than allowed by {(now.speed - bound)[now.valid].max():g} m/s"
    lanes = after[keys.ROAD, "lanes"] if base.traffic.own_roads else base.road.lanes
    if not (((now.target_lane >= 0) & (now.target_lane < lanes)) | ~now.valid).all():
        yield "a lane that is not there"
    # With an ego that keeps its lane, rule-driven cars never touch each other.
    alone = (
        traffic in RULES and choice["policy"] == "keep" and "blind_share" not in choice["traffic"]
    )
    if alone and choice["env"] in ("highway", "dense"):
        touching = pair_overlaps(now).any(-1).any(-1) & ~after[keys.EVENTS, "hard_crash"][:, 0]
        if touching.any():
            yield f"rule-driven cars overlap in {int(touching.sum())} rows"


def memory(tally: Tally, minutes: float, seed: int) -> None:
    """Resident memory of this process while one configuration runs.

    Flat within :data:`FLAT` over the last half.
    """
    env = ganlane.make_env("gan_calibrated", 64, seed=seed, goal_m=500.0, mask="safe")
    generator, td = torch.Generator().manual_seed(seed), env.reset()
    begun, sampled = time.monotonic(), []
    while (passed := time.monotonic() - begun) < 60.0 * minutes:
        td["action"] = actions("legal", td, generator)
        _, td = env.step_and_maybe_reset(td)
        if passed > 30.0 * minutes:
            sampled.append(resident_mib())
    spread = max(sampled) / min(sampled) - 1.0
    tally.what[f"MiB resident memory, within {spread:.2%} over the last half"] = round(sampled[-1])
    if spread > FLAT:
        tally.fail(
            f"resident memory from {min(sampled):.0f} to {max(sampled):.0f} MiB in {minutes / 2:g} minutes"
        )


def resident_mib() -> float:
    """Resident memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
